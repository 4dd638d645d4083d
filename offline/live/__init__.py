"""A map of drives under way, made anew every second from what their logs hold.

In: logs that are being written. Out: maps of all drives up to now, lines and a page about them, and at the end the map
of the whole drives. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
