"""AprilTags as printed objects: families and their bit patterns, lists of ids, and shifts of their edges in pictures.

In: a family and ids. Out: bit patterns, and the shift of corners caused by a shift of a tag's edges. In the paper: its
landmarks.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
