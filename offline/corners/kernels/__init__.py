"""Compiled parts of the bundle adjustment: lens, planar pose, one view's residuals, steps."""
