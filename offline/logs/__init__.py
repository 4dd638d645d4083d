"""Looking into logs: what one holds, a damaged one made whole, tags detected again in recorded pictures.

In: run logs. Out: a summary, or a new log; the old one stays as it is. In the paper: its recorded data.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
