"""Joint solve of all runs of a component, and checks of the result.

In: aligned local maps. Out: the jointly solved component with its typed result, its scale, its weak constraints, tests
of tape measurements, and components joined over single tags. In the paper: the joint solve over all robots.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
