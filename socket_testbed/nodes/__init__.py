"""The ROS boundary: thin nodes that declare, convert, call one core method and publish."""
