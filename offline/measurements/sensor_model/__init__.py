"""The sensor model: turns tag corners in pixels, or imported positions, into planar observations with covariances."""
