"""Small helpers without knowledge of robots, on which every other package builds.

In: nothing of ours. Out: array types, files that are written whole or not at all, strict YAML, the frame of a command
line program, and checks of encoded pictures before they are decoded. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
