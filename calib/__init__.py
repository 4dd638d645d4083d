"""The ground floor: frames, cameras, wheels and the robot's file."""
