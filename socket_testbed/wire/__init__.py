"""What goes over the wire: topics, message types, and the numbers in their bytes, without ROS."""
