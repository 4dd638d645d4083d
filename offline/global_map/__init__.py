"""All runs of a component in one solve, and what of the result to check.

In: aligned local maps. Out: the jointly solved component with its typed result, its scale, its weak constraints, tape
measurements held against it, and components joined over single tags. In the paper: the joint solve over all robots.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
