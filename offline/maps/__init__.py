"""The typed map and its files: map.json, map.npz, tags.csv, trajectories, map.mcap.

In: results of the solve, or a folder that `map` wrote. Out: `MapResult` and files, as in docs/formats.md. In the paper:
the resulting map.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
