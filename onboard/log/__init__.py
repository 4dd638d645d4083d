"""The run log: its messages, and reading and writing it without ever returning a wrong message.

In: messages with stamps; files that may be damaged. Out: MCAP files of which each opens alone, or the messages in them
and what was lost; pictures as bytes and as arrays. In the paper: the recorded data between robot and estimate.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
