"""Where one more pass or one more tag would help a map most.

In: a solved graph. Out: candidates with what each would do to the worst tag. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
