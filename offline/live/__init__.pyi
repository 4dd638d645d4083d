from .drives import RunState
from .live_map import LiveMap, Update

__all__ = ["LiveMap", "RunState", "Update"]
