"""Compiled loops, worker processes, clusters, stages with their costs, and file helpers, none specific to robots.

In: files and functions. Out: `njit` and related decorators (numba with a cache that follows edits), `Workers`,
`Stages`, typed CSV tables, size-checked .npz files, and limits for the logs of one command. The paper has no such
block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
