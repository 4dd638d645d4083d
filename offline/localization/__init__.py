"""Localizes a run in a finished map, which does not change: as a whole, or online observation by observation.

In: a map and a log, or live observations. Out: the trajectory of the run, with covariances that include the map's. The
paper names this as a use of its map.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
