from .archive import ArchivedCalibration, ArchivedSegment, nominal_row
from .dataframe import to_dataframe
from .datum import DatumKind, SurveyedTag, TagDatum, datum_centre
from .files import read_map, write_map
from .fit_results import AlignmentResult, AlternativeResult, MeasurementResult, Misfit, OutlierTag
from .frame import (
    CrossCovariances,
    motion_jacobian,
    move_to_start,
    move_to_tags,
    relative_to_tags,
    start_vectors,
    tags_own_axes,
)
from .json_document import map_as_json
from .mcap import MAP_FILE, write_mcap
from .model import JSON_FILE, MapModel
from .parameter_results import (
    MAX_SIGMAS,
    NOT_NEEDED,
    CalibrationChoice,
    CalibrationResult,
    ConsistencyCheck,
    FittedNoise,
    FittedParameter,
    RobotNumber,
    ScaleBudget,
)
from .result import (
    AdviceResult,
    Component,
    FloorSigmas,
    GraphEdges,
    MapResult,
    RunResult,
    TagPose,
    TagResult,
)
from .scene import RobotPose, frame_of, robot_messages, scene_messages
from .shape import (
    SIGMAS_95,
    common_motion,
    drawn_covariances,
    largest_sigmas_m,
    shape_of,
    without_common_motion,
)
from .tags_table import tags_csv
from .tum import write_tum
from .widening import TagScatter, inflate_covariances, inflate_edges

__all__ = [
    "JSON_FILE",
    "MAP_FILE",
    "MAX_SIGMAS",
    "NOT_NEEDED",
    "SIGMAS_95",
    "AdviceResult",
    "AlignmentResult",
    "AlternativeResult",
    "ArchivedCalibration",
    "ArchivedSegment",
    "CalibrationChoice",
    "CalibrationResult",
    "Component",
    "ConsistencyCheck",
    "CrossCovariances",
    "DatumKind",
    "FittedNoise",
    "FittedParameter",
    "FloorSigmas",
    "GraphEdges",
    "MapModel",
    "MapResult",
    "MeasurementResult",
    "Misfit",
    "OutlierTag",
    "RobotNumber",
    "RobotPose",
    "RunResult",
    "ScaleBudget",
    "SurveyedTag",
    "TagDatum",
    "TagPose",
    "TagResult",
    "TagScatter",
    "common_motion",
    "datum_centre",
    "drawn_covariances",
    "frame_of",
    "inflate_covariances",
    "inflate_edges",
    "largest_sigmas_m",
    "map_as_json",
    "motion_jacobian",
    "move_to_start",
    "move_to_tags",
    "nominal_row",
    "read_map",
    "relative_to_tags",
    "robot_messages",
    "scene_messages",
    "shape_of",
    "start_vectors",
    "tags_csv",
    "tags_own_axes",
    "to_dataframe",
    "without_common_motion",
    "write_map",
    "write_mcap",
    "write_tum",
]
