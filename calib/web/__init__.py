"""What the pages in a browser have in common: the page of a recording and the page of a map.

In: an address, and an application that answers requests. Out: a listening socket with a token, URLs that are printed,
and a server that answers only those who have the token, and bounds what clients may take. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
