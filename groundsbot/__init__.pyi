from .calib.errors import GroundsbotError
from .calib.noise import NoiseParameters
from .offline.bag_import import import_bag
from .offline.bag_topics import BagOptions
from .offline.chain import chains_of
from .offline.import_robot import ImportOptions
from .offline.importers import import_folder
from .offline.localization import Localization
from .offline.localizing import localize
from .offline.map_io import read_map, write_map
from .offline.online_drive import TagReading
from .offline.online_localizer import OnlineLocalizer, OnlinePose
from .offline.pipeline import build_map
from .offline.result import Component, MapResult, RunResult, TagResult
from .offline.run import Run, load_run, read_robot_file
from .onboard.log_reader import find_logs

__all__ = [
    "BagOptions",
    "Component",
    "GroundsbotError",
    "ImportOptions",
    "Localization",
    "MapResult",
    "NoiseParameters",
    "OnlineLocalizer",
    "OnlinePose",
    "Run",
    "RunResult",
    "TagReading",
    "TagResult",
    "build_map",
    "chains_of",
    "find_logs",
    "import_bag",
    "import_folder",
    "load_run",
    "localize",
    "read_map",
    "read_robot_file",
    "write_map",
]
