"""Bounds on what no model of a drive accounts for."""

from typing import Final

# A place with a larger sigma is unknown within the building: a tag there may be any tag.
REACH_M: Final = 10.0
# Of each coordinate of a shared tag, beyond what the covariances say.
UNMODELLED_SIGMA_M: Final = 0.01
