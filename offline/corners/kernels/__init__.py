"""Compiled parts of the bundle adjustment: lens, planar pose, residuals of one detection, retraction."""
