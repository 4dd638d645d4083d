"""The motion model: composes wheel readings into odometry between keyframes, on exact arcs, with covariances."""
