"""Calibration boards (ChArUco, chessboard, AprilGrid), and their detection in pictures to hundredths of a pixel.

In: pictures of a board. Out: views with corners in pixels, which views a set still lacks, and the reason if no board
was found. The paper takes its camera as calibrated.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
