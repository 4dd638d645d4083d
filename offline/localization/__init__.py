"""A run in a finished map, which stays as it is; at once or observation by observation.

In: a map and a log, or live observations. Out: where the run drove, with covariances that count the map's own. The
paper names it as a use of its map.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
