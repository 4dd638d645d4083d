"""AprilTags as printed objects: families and their bit patterns, lists of ids, and where edges are seen.

In: a family and ids. Out: bit patterns, and how corners move where a camera sees the edges of a tag too far out. In the
paper: its landmarks.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
