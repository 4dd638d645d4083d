from .line_server import serve_lines
from .live_map import LiveMap
from .page import NewestState, serve_page
from .ports import parse_port
from .poses import RunLocalizer, StampedPose
from .topic_feed import TopicFeed, is_address
from .words import hints, update_line

__all__ = [
    "LiveMap",
    "NewestState",
    "RunLocalizer",
    "StampedPose",
    "TopicFeed",
    "hints",
    "is_address",
    "parse_port",
    "serve_lines",
    "serve_page",
    "update_line",
]
