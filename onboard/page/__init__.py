"""The page on the robot: a recording, a capture or a check on a phone, served by a process of its own.

In: the status of a recording and pictures with their tags, offered without waiting. Out: a page in a browser; starts
and stops of runs and checks, and notes for the log. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
