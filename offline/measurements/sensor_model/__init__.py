"""The sensor model: tag corners in pixels, or imported positions, to tag positions on the floor with covariances."""
