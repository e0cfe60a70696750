"""The page in a browser, with three sources: a report, a trial, a running testbed; no ROS."""
