"""The live testbed without ROS: the estimator, bring-up, processes, hardware."""
