from .line_server import parse_port, serve_lines
from .live_map import LiveMap
from .page import NewestState, serve_page
from .poses import RunLocalizer, StampedPose
from .words import hints, update_line

__all__ = [
    "LiveMap",
    "NewestState",
    "RunLocalizer",
    "StampedPose",
    "hints",
    "parse_port",
    "serve_lines",
    "serve_page",
    "update_line",
]
