"""Presentation of the map: report.html and map.png.

In: a map and what it was made from. Out: a page that opens from disk without a network, and a picture. In the paper:
its figures of maps.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
