"""Bounds on errors that the measurement models do not contain."""

from typing import Final

# A position with a larger sigma is not known within the building, so the tag there could be any tag.
REACH_M: Final = 10.0
# Sigma of each coordinate of a shared tag, in addition to its covariance.
UNMODELLED_SIGMA_M: Final = 0.01
