"""Camera calibration: views of a board to intrinsics with sigmas, and whether a calibration still fits.

In: pictures of a board. Out: a camera file, a page that judges it, or one line that says what is missing. The paper
takes its camera as calibrated.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
