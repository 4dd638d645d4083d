from .coarse_segment import coarse_keyframes, coarsen, informative_keyframes, refine_poses
from .covariance_components import CovarianceParts
from .growing_run import GrowingRun, MessageSource
from .motion_model.gyro import GYRO_BIAS, GYRO_PARAMETERS, HeadingDifferences
from .motion_model.heading_fusion import GyroEstimate
from .motion_model.motion_model import ODOMETRY_NOISE, SegmentOdometry, WheelSegment, compose_odometry
from .motion_model.step_covariance import growth
from .motion_model.wheel_segments import wheel_distances
from .passes import FEW_OBSERVATIONS, GAP_M, MOST_MISREAD, cells_of, passes_of, without_unconfirmed_tracks
from .run import ALONE, Inputs, RobotFile, Run, load_run, read_robot_file
from .run_messages import MEASURED_TOPICS, RunEvent
from .segment import Segment, index_observed_tags, segments_of
from .sensor_model.corner_bias import least_shared_by_corners, least_shared_variance
from .sensor_model.imported_positions import MAX_RANGE_M, POSITION_NOISE, STAMP_NOISE, read_positions
from .sensor_model.observations import Observations, tag_rates, value_rates
from .sensor_model.sensor_model import SAME_SIZE_M, read_detections
from .sensor_model.tag_pose import UNIT_CORNERS
from .smoothed_faces import with_smoothed_faces
from .speeds import most_times, speed_profile
from .tags import Detections, Positions, TagKey
from .tape import MeasuredDistance, MeasuredStart, Measurements, Placement, TapeOptions, parse_measurements
from .unmodelled import REACH_M, UNMODELLED_SIGMA_M

__all__ = [
    "ALONE",
    "FEW_OBSERVATIONS",
    "GAP_M",
    "GYRO_BIAS",
    "GYRO_PARAMETERS",
    "MAX_RANGE_M",
    "MEASURED_TOPICS",
    "MOST_MISREAD",
    "ODOMETRY_NOISE",
    "POSITION_NOISE",
    "REACH_M",
    "SAME_SIZE_M",
    "STAMP_NOISE",
    "UNIT_CORNERS",
    "UNMODELLED_SIGMA_M",
    "CovarianceParts",
    "Detections",
    "GrowingRun",
    "GyroEstimate",
    "HeadingDifferences",
    "Inputs",
    "MeasuredDistance",
    "MeasuredStart",
    "Measurements",
    "MessageSource",
    "Observations",
    "Placement",
    "Positions",
    "RobotFile",
    "Run",
    "RunEvent",
    "Segment",
    "SegmentOdometry",
    "TagKey",
    "TapeOptions",
    "WheelSegment",
    "cells_of",
    "coarse_keyframes",
    "coarsen",
    "compose_odometry",
    "growth",
    "index_observed_tags",
    "informative_keyframes",
    "least_shared_by_corners",
    "least_shared_variance",
    "load_run",
    "most_times",
    "parse_measurements",
    "passes_of",
    "read_detections",
    "read_positions",
    "read_robot_file",
    "refine_poses",
    "segments_of",
    "speed_profile",
    "tag_rates",
    "value_rates",
    "wheel_distances",
    "with_smoothed_faces",
    "without_unconfirmed_tracks",
]
