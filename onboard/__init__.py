"""What runs on the robot's computer: reads wheels and camera, detects tags, writes a run log."""
