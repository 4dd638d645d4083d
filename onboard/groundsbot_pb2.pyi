from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class StampSource(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STAMP_SOURCE_UNSPECIFIED: _ClassVar[StampSource]
    STAMP_SOURCE_CAMERA: _ClassVar[StampSource]
    STAMP_SOURCE_ARRIVAL: _ClassVar[StampSource]
    STAMP_SOURCE_FILE_NAME: _ClassVar[StampSource]
    STAMP_SOURCE_VIDEO: _ClassVar[StampSource]
    STAMP_SOURCE_SIMULATION: _ClassVar[StampSource]

class Severity(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SEVERITY_UNSPECIFIED: _ClassVar[Severity]
    SEVERITY_INFO: _ClassVar[Severity]
    SEVERITY_WARNING: _ClassVar[Severity]
    SEVERITY_ERROR: _ClassVar[Severity]
STAMP_SOURCE_UNSPECIFIED: StampSource
STAMP_SOURCE_CAMERA: StampSource
STAMP_SOURCE_ARRIVAL: StampSource
STAMP_SOURCE_FILE_NAME: StampSource
STAMP_SOURCE_VIDEO: StampSource
STAMP_SOURCE_SIMULATION: StampSource
SEVERITY_UNSPECIFIED: Severity
SEVERITY_INFO: Severity
SEVERITY_WARNING: Severity
SEVERITY_ERROR: Severity

class RunInfo(_message.Message):
    __slots__ = ("run_id", "robot_id", "software_version", "robot_yaml", "run_epoch_ns")
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    ROBOT_ID_FIELD_NUMBER: _ClassVar[int]
    SOFTWARE_VERSION_FIELD_NUMBER: _ClassVar[int]
    ROBOT_YAML_FIELD_NUMBER: _ClassVar[int]
    RUN_EPOCH_NS_FIELD_NUMBER: _ClassVar[int]
    run_id: str
    robot_id: str
    software_version: str
    robot_yaml: str
    run_epoch_ns: int
    def __init__(self, run_id: _Optional[str] = ..., robot_id: _Optional[str] = ..., software_version: _Optional[str] = ..., robot_yaml: _Optional[str] = ..., run_epoch_ns: _Optional[int] = ...) -> None: ...

class WheelEncoders(_message.Message):
    __slots__ = ("stamp_ns", "device_time_us", "boot_id", "sequence", "ticks_left", "ticks_right", "flags")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_US_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    TICKS_LEFT_FIELD_NUMBER: _ClassVar[int]
    TICKS_RIGHT_FIELD_NUMBER: _ClassVar[int]
    FLAGS_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    device_time_us: int
    boot_id: int
    sequence: int
    ticks_left: int
    ticks_right: int
    flags: int
    def __init__(self, stamp_ns: _Optional[int] = ..., device_time_us: _Optional[int] = ..., boot_id: _Optional[int] = ..., sequence: _Optional[int] = ..., ticks_left: _Optional[int] = ..., ticks_right: _Optional[int] = ..., flags: _Optional[int] = ...) -> None: ...

class Gyro(_message.Message):
    __slots__ = ("stamp_ns", "yaw_rate_rad_s", "device_time_us", "boot_id", "sequence")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    YAW_RATE_RAD_S_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_US_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    yaw_rate_rad_s: float
    device_time_us: int
    boot_id: int
    sequence: int
    def __init__(self, stamp_ns: _Optional[int] = ..., yaw_rate_rad_s: _Optional[float] = ..., device_time_us: _Optional[int] = ..., boot_id: _Optional[int] = ..., sequence: _Optional[int] = ...) -> None: ...

class TagDetection(_message.Message):
    __slots__ = ("family", "tag_id", "hamming", "decision_margin", "corners_px")
    FAMILY_FIELD_NUMBER: _ClassVar[int]
    TAG_ID_FIELD_NUMBER: _ClassVar[int]
    HAMMING_FIELD_NUMBER: _ClassVar[int]
    DECISION_MARGIN_FIELD_NUMBER: _ClassVar[int]
    CORNERS_PX_FIELD_NUMBER: _ClassVar[int]
    family: str
    tag_id: int
    hamming: int
    decision_margin: float
    corners_px: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, family: _Optional[str] = ..., tag_id: _Optional[int] = ..., hamming: _Optional[int] = ..., decision_margin: _Optional[float] = ..., corners_px: _Optional[_Iterable[float]] = ...) -> None: ...

class TagDetections(_message.Message):
    __slots__ = ("stamp_ns", "frame_sequence", "has_wheel_sequence", "wheel_sequence", "width_px", "height_px", "detections", "detector", "detector_settings", "stamp_source")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    HAS_WHEEL_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    WHEEL_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    WIDTH_PX_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_PX_FIELD_NUMBER: _ClassVar[int]
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    DETECTOR_FIELD_NUMBER: _ClassVar[int]
    DETECTOR_SETTINGS_FIELD_NUMBER: _ClassVar[int]
    STAMP_SOURCE_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    frame_sequence: int
    has_wheel_sequence: bool
    wheel_sequence: int
    width_px: int
    height_px: int
    detections: _containers.RepeatedCompositeFieldContainer[TagDetection]
    detector: str
    detector_settings: str
    stamp_source: StampSource
    def __init__(self, stamp_ns: _Optional[int] = ..., frame_sequence: _Optional[int] = ..., has_wheel_sequence: _Optional[bool] = ..., wheel_sequence: _Optional[int] = ..., width_px: _Optional[int] = ..., height_px: _Optional[int] = ..., detections: _Optional[_Iterable[_Union[TagDetection, _Mapping]]] = ..., detector: _Optional[str] = ..., detector_settings: _Optional[str] = ..., stamp_source: _Optional[_Union[StampSource, str]] = ...) -> None: ...

class ClockAnchor(_message.Message):
    __slots__ = ("stamp_ns", "monotonic_ns", "realtime_ns", "synchronised")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    MONOTONIC_NS_FIELD_NUMBER: _ClassVar[int]
    REALTIME_NS_FIELD_NUMBER: _ClassVar[int]
    SYNCHRONISED_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    monotonic_ns: int
    realtime_ns: int
    synchronised: bool
    def __init__(self, stamp_ns: _Optional[int] = ..., monotonic_ns: _Optional[int] = ..., realtime_ns: _Optional[int] = ..., synchronised: _Optional[bool] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("stamp_ns", "severity", "kind", "text", "count")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SEVERITY_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    severity: Severity
    kind: str
    text: str
    count: int
    def __init__(self, stamp_ns: _Optional[int] = ..., severity: _Optional[_Union[Severity, str]] = ..., kind: _Optional[str] = ..., text: _Optional[str] = ..., count: _Optional[int] = ...) -> None: ...

class PlanarOdometry(_message.Message):
    __slots__ = ("stamp_ns", "wheels", "pose", "covariance")
    class WheelDistances(_message.Message):
        __slots__ = ("left_m", "right_m")
        LEFT_M_FIELD_NUMBER: _ClassVar[int]
        RIGHT_M_FIELD_NUMBER: _ClassVar[int]
        left_m: float
        right_m: float
        def __init__(self, left_m: _Optional[float] = ..., right_m: _Optional[float] = ...) -> None: ...
    class PoseInOdom(_message.Message):
        __slots__ = ("x_m", "y_m", "theta_rad")
        X_M_FIELD_NUMBER: _ClassVar[int]
        Y_M_FIELD_NUMBER: _ClassVar[int]
        THETA_RAD_FIELD_NUMBER: _ClassVar[int]
        x_m: float
        y_m: float
        theta_rad: float
        def __init__(self, x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., theta_rad: _Optional[float] = ...) -> None: ...
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    WHEELS_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    wheels: PlanarOdometry.WheelDistances
    pose: PlanarOdometry.PoseInOdom
    covariance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, stamp_ns: _Optional[int] = ..., wheels: _Optional[_Union[PlanarOdometry.WheelDistances, _Mapping]] = ..., pose: _Optional[_Union[PlanarOdometry.PoseInOdom, _Mapping]] = ..., covariance: _Optional[_Iterable[float]] = ...) -> None: ...

class TagObservation(_message.Message):
    __slots__ = ("family", "tag_id", "cartesian", "polar", "covariance", "quaternion_xyzw")
    class Cartesian(_message.Message):
        __slots__ = ("x_m", "y_m", "z_m", "has_z")
        X_M_FIELD_NUMBER: _ClassVar[int]
        Y_M_FIELD_NUMBER: _ClassVar[int]
        Z_M_FIELD_NUMBER: _ClassVar[int]
        HAS_Z_FIELD_NUMBER: _ClassVar[int]
        x_m: float
        y_m: float
        z_m: float
        has_z: bool
        def __init__(self, x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., z_m: _Optional[float] = ..., has_z: _Optional[bool] = ...) -> None: ...
    class Polar(_message.Message):
        __slots__ = ("range_m", "bearing_rad")
        RANGE_M_FIELD_NUMBER: _ClassVar[int]
        BEARING_RAD_FIELD_NUMBER: _ClassVar[int]
        range_m: float
        bearing_rad: float
        def __init__(self, range_m: _Optional[float] = ..., bearing_rad: _Optional[float] = ...) -> None: ...
    FAMILY_FIELD_NUMBER: _ClassVar[int]
    TAG_ID_FIELD_NUMBER: _ClassVar[int]
    CARTESIAN_FIELD_NUMBER: _ClassVar[int]
    POLAR_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_XYZW_FIELD_NUMBER: _ClassVar[int]
    family: str
    tag_id: int
    cartesian: TagObservation.Cartesian
    polar: TagObservation.Polar
    covariance: _containers.RepeatedScalarFieldContainer[float]
    quaternion_xyzw: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, family: _Optional[str] = ..., tag_id: _Optional[int] = ..., cartesian: _Optional[_Union[TagObservation.Cartesian, _Mapping]] = ..., polar: _Optional[_Union[TagObservation.Polar, _Mapping]] = ..., covariance: _Optional[_Iterable[float]] = ..., quaternion_xyzw: _Optional[_Iterable[float]] = ...) -> None: ...

class TagObservations(_message.Message):
    __slots__ = ("stamp_ns", "frame", "observations")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    OBSERVATIONS_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    frame: str
    observations: _containers.RepeatedCompositeFieldContainer[TagObservation]
    def __init__(self, stamp_ns: _Optional[int] = ..., frame: _Optional[str] = ..., observations: _Optional[_Iterable[_Union[TagObservation, _Mapping]]] = ...) -> None: ...

class WheelSpeeds(_message.Message):
    __slots__ = ("stamp_ns", "left_m_s", "right_m_s")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    LEFT_M_S_FIELD_NUMBER: _ClassVar[int]
    RIGHT_M_S_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    left_m_s: float
    right_m_s: float
    def __init__(self, stamp_ns: _Optional[int] = ..., left_m_s: _Optional[float] = ..., right_m_s: _Optional[float] = ...) -> None: ...
