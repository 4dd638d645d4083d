from .calib.errors import GroundsbotError
from .calib.robot import NoiseParameters
from .offline.importing import BagOptions, ImportOptions, WpilogOptions, import_bag, import_folder, import_wpilog
from .offline.localization import Localization, OnlineLocalizer, OnlinePose, TagMeasurement, localize
from .offline.mapping import build_map, parse_frame
from .offline.maps import Component, MapResult, RunResult, TagResult, read_map, write_map
from .offline.measurements import Run, load_run, read_robot_file, segments_of
from .onboard.log import find_logs

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
    "TagMeasurement",
    "TagResult",
    "WpilogOptions",
    "build_map",
    "find_logs",
    "import_bag",
    "import_folder",
    "import_wpilog",
    "load_run",
    "localize",
    "parse_frame",
    "read_map",
    "read_robot_file",
    "segments_of",
    "write_map",
]
