"""ROS 2 nodes of depthpose."""
