from .calib.errors import GroundsbotError
from .calib.robot import NoiseParameters
from .fixtures.simulate import simulate
from .offline.commands import compare_map, export_map
from .offline.errors import UnknownNameError
from .offline.evaluation import MapErrors, SurveyErrors
from .offline.importing import BagOptions, ImportOptions, WpilogOptions, import_bag, import_folder, import_wpilog
from .offline.localization import (
    GyroDifference,
    Localization,
    LocatedRun,
    OnlineLocalizer,
    OnlinePose,
    TagMeasurement,
    localize,
)
from .offline.mapping import build_map, parse_frame
from .offline.maps import Component, MapResult, RunResult, TagResult, read_map, to_dataframe, write_map
from .offline.measurements import Run, load_run, read_robot_file, segments_of
from .offline.report.picture import draw_map
from .onboard.log import find_logs

__all__ = [
    "BagOptions",
    "Component",
    "GroundsbotError",
    "GyroDifference",
    "ImportOptions",
    "Localization",
    "LocatedRun",
    "MapErrors",
    "MapResult",
    "NoiseParameters",
    "OnlineLocalizer",
    "OnlinePose",
    "Run",
    "RunResult",
    "SurveyErrors",
    "TagMeasurement",
    "TagResult",
    "UnknownNameError",
    "WpilogOptions",
    "build_map",
    "compare_map",
    "draw_map",
    "export_map",
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
    "simulate",
    "to_dataframe",
    "write_map",
]
