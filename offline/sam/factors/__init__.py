"""Residuals and Jacobians of each kind of measurement, robust losses, and priors."""
