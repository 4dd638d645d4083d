"""ROS 1 and ROS 2 bags, read without ROS, to run logs: odometry, camera mount, detections or pictures."""
