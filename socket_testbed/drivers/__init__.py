"""Drivers of the testbed's hardware, without ROS: each is given its bus, line or socket."""
