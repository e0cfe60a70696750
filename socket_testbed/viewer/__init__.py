"""The page in a browser: a running testbed, or a trial, as it is seen; no ROS."""
