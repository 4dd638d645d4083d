"""Self-calibration: which calibration parameters the drives estimate better than robot.yaml gives them.

In: runs and segments. Out: runs with freed parameters, the reasons, and corrected robot files. Not in the paper, which
assumes calibrated robots.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
