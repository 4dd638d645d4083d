"""The noise of wheels and tag observations, fitted to the residuals of the local maps.

In: local maps. Out: noise parameters with intervals, and local maps solved under them. The paper fixes its covariances
by hand.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
