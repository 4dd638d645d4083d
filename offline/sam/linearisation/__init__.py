"""Compiled linearisation: the factors' residuals and Jacobians straight into blocks of the normal equations."""
