"""How far off what is in no model of these drives may be."""

from typing import Final

# What is told to no better than this is told to be somewhere: the next wall, the next door.
REACH_M: Final = 10.0


# Of each coordinate of a shared tag, beyond what the covariances say.
UNMODELLED_SIGMA_M: Final = 0.01
