from .archive import ArchivedCalibration, ArchivedSegment, nominal_row
from .files import JSON_FILE, read_map, write_map
from .fit_results import AlignmentResult, AlternativeResult, MeasurementResult, Misfit, OutlierTag
from .json_document import advice_as_json, map_as_json
from .mcap import MAP_FILE, write_mcap
from .model import MapModel
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
    StartToStart,
    TagPose,
    TagResult,
)
from .tags_table import tags_csv
from .tum import write_tum
from .widening import TagScatter, inflate_covariances

__all__ = [
    "JSON_FILE",
    "MAP_FILE",
    "MAX_SIGMAS",
    "NOT_NEEDED",
    "AdviceResult",
    "AlignmentResult",
    "AlternativeResult",
    "ArchivedCalibration",
    "ArchivedSegment",
    "CalibrationChoice",
    "CalibrationResult",
    "Component",
    "ConsistencyCheck",
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
    "RunResult",
    "ScaleBudget",
    "StartToStart",
    "TagPose",
    "TagResult",
    "TagScatter",
    "advice_as_json",
    "inflate_covariances",
    "map_as_json",
    "nominal_row",
    "read_map",
    "tags_csv",
    "write_map",
    "write_mcap",
    "write_tum",
]
