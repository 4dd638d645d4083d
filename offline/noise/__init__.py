"""Fit of the noise of wheels and tag observations to the residuals of local maps.

In: local maps. Out: noise parameters with intervals, and local maps solved under them. In the paper the covariances are
chosen by hand.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
