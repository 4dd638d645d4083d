"""Camera calibration: estimation of intrinsics with sigmas from views of a board, and checks of a calibration.

In: pictures of a board. Out: a camera file and a report, or an error that names what is missing. The paper takes its
camera as calibrated.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
