"""Boards and tags as PDF, true to scale.

In: description of a board or of tags, and a paper size. Out: PDF files. In the paper: preparation of the landmarks.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
