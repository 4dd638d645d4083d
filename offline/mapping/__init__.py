"""The mapping pipeline: calls each block in order.

In: runs and options. Out: `MapResult`, with the findings of each block as warnings. In the paper: the figure of the
whole system. Read `pipeline.build_map` first.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
