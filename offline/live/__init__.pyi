from .line_server import LineServer, serve_lines
from .live_map import LiveMap
from .page import NewestState, serve_page
from .ports import parse_address, parse_port
from .poses import RunLocalizer, StampedPose
from .scene_server import SceneServer, serve_scenes
from .topic_feed import TopicFeed, is_address
from .words import hints, update_line

__all__ = [
    "LineServer",
    "LiveMap",
    "NewestState",
    "RunLocalizer",
    "SceneServer",
    "StampedPose",
    "TopicFeed",
    "hints",
    "is_address",
    "parse_address",
    "parse_port",
    "serve_lines",
    "serve_page",
    "serve_scenes",
    "update_line",
]
