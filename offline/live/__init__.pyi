from .live_map import LiveMap
from .words import hints, update_line

__all__ = ["LiveMap", "hints", "update_line"]
