"""Boards and tags as PDF, true to scale.

In: a board's or tags' description and a paper size. Out: PDF files. In the paper: making the landmarks.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
