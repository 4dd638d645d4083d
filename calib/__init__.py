"""Frames, cameras, boards, wheels and robot.yaml: the base of all other packages."""
