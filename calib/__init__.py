"""Frames, cameras, boards, wheels and the robot's file: what every other package builds on."""
