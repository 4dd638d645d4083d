"""Residuals and Jacobians of each kind of measurement, and priors."""
