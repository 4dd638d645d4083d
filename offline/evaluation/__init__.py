"""Comparison of a map with ground truth or a survey: errors, and consistency of the covariances.

In: a map and truth.json or a survey. Out: errors, NEES, and survey points that look wrong. In the paper: its results
against hand measurements.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
