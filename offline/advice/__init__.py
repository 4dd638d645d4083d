"""The additional drive or tag that would reduce the uncertainty of a map most.

In: a solved graph. Out: candidates, each with the predicted sigma of the worst tag. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
