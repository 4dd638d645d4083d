"""Tag detection: pictures in, tag corners in raw pixels out, in a process of its own.

In: encoded pictures. Out: detections with one corner order and OpenCV's pixel convention, corners refined on the
picture. In the paper: the tag detector before the sensor model. Used by the recorder and, on recorded pictures,
offline.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
