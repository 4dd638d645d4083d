"""Compiled loops, stages with their costs, and small file helpers. Knows nothing of robots.

In: files and functions. Out: `njit` and its kin (numba with a cache that follows edits), `Stages`, typed CSV tables,
guarded .npz files, and what the logs of one command may cost together. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
