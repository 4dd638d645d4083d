"""The motion model: wheel readings to odometry between keyframes, on exact arcs, with propagated covariances."""
