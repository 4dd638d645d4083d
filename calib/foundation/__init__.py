"""Small helpers for all packages, independent of robots.

In: nothing of this project. Out: array types, atomic writing of files and folders, strict YAML, the frame of a command
line program, and checks of encoded pictures before they are decoded. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
