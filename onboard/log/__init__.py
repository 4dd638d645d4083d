"""The run log: its messages, writing, and reading that never returns a corrupt message.

In: messages with stamps, and files that may be damaged. Out: MCAP files that can each be read alone, the messages in
them and what was lost, and pictures as bytes and as arrays. In the paper: the recorded data between robot and estimate.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
