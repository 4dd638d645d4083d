"""Detection of tags in pictures, in a child process.

In: encoded pictures. Out: detections with tag corners in raw (distorted) pixels, in one corner order and OpenCV's pixel
convention, refined on the picture. In the paper: the tag detector before the sensor model. It is used by the recorder,
and offline on recorded pictures.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
