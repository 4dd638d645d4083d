from .live_map import LiveMap
from .page import NewestState, parse_page, serve_page
from .words import hints, update_line

__all__ = ["LiveMap", "NewestState", "hints", "parse_page", "serve_page", "update_line"]
