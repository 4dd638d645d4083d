"""The calibration board (ChArUco), and finding it in pictures to hundredths of a pixel.

In: pictures of a board. Out: views with corners in pixels, what a set of views still misses, and why no board was
found. The paper takes its camera as calibrated.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
