"""The page in a browser, for a report, a trial or a running testbed; without ROS."""
