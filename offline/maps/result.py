"""What mapping hands out: typed, in the map frame, in SI units.

A run with unbroken odometry is one segment; where the odometry broke, a run has several segments (segments), named
`<run>` and `<run>_stretch2`, ... Each is placed on its own, like another run.
"""

from dataclasses import dataclass, field
from math import atan2
from pathlib import Path

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.maps.archive import ArchivedCalibration, ArchivedSegment
from groundsbot.offline.maps.fit_results import AlignmentResult, MeasurementResult, Misfit, SuspectTag
from groundsbot.offline.maps.model import MapModel
from groundsbot.offline.maps.parameter_results import (
    CalibrationChoice,
    CalibrationResult,
    ConsistencyCheck,
    FittedNoise,
    RobotNumber,
    ScaleBudget,
)


@dataclass(frozen=True)
class RunResult:
    """One segment of keyframes in its component's map frame."""

    name: str  # unique: robot id and run id, and the segment where there are several
    run: str  # the run it belongs to: equal to name unless it is a later segment
    log: Path
    robot_id: str
    run_id: str
    T_map_start: FloatArray  # (3,) x_m, y_m, theta_rad
    covariance: FloatArray  # (3, 3) of the start, map frame, (x, y, theta): m^2, m rad, rad^2
    stamps_ns: IntArray  # (K,)
    T_map_base: FloatArray  # (K, 3)
    distance_m: float  # driven, by the wheels
    # (7,) x, y, z in m and quaternion x, y, z, w: the camera as the solve corrected its mount; None: it has none.
    T_base_camera: FloatArray | None = None

    @property
    def n_keyframes(self) -> int:
        """How many poses the run has."""
        return len(self.stamps_ns)


@dataclass(frozen=True)
class TagPose:
    """How one tag hangs in space.

    Attributes:
        height_m: of its centre above the floor.
        quaternion_xyzw: (4,) R_map_tag.
        covariance: (6, 6) of x, y, height and a small turn about map's axes: m^2, m rad, rad^2.
    """

    height_m: float
    quaternion_xyzw: FloatArray
    covariance: FloatArray

    @property
    def yaw_rad(self) -> float:
        """Where the face looks on the floor."""
        x, y, z, w = self.quaternion_xyzw.tolist()
        return atan2(2.0 * (y * z - x * w), 2.0 * (x * z + y * w))


@dataclass(frozen=True)
class TagResult:
    """One tag in its component's map frame."""

    family: str
    tag_id: int
    instance: str  # empty unless one id hangs in several places: a, b, ...
    size_m: float | None  # None: imported positions
    position_m: FloatArray  # (2,)
    covariance: FloatArray  # (2, 2) m^2
    n_observations: int
    runs: tuple[str, ...]  # names of the runs that saw it
    pose: TagPose | None = None  # None where it is known on the floor only
    # By how many times its passes scatter more than chance explains, in sigmas; 1 where it does. The covariance has it.
    sigma_factor: float = 1.0

    @property
    def label(self) -> str:
        """Its number as people say it, with the instance."""
        return f"{self.tag_id}{self.instance}"

    @property
    def full_label(self) -> str:
        """The same with its family, for maps of several."""
        return f"{self.family}:{self.label}"


@dataclass(frozen=True)
class StartToStart:
    """From the start of one run to the start of another in one component."""

    a: str
    b: str
    vector_m: FloatArray  # (2,) in the map frame
    covariance: FloatArray  # (2, 2)

    @property
    def distance_m(self) -> float:
        """Length of the vector."""
        return float((self.vector_m @ self.vector_m) ** 0.5)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the distance, first order; of the longer axis where the distance is nothing."""
        distance_m = self.distance_m
        if distance_m < 1e-9:
            return float(max(self.covariance[0, 0], self.covariance[1, 1]) ** 0.5)
        direction = self.vector_m / distance_m
        return float((direction @ self.covariance @ direction) ** 0.5)


@dataclass(frozen=True)
class GraphEdges:
    """What a component's poses and tags were solved from, with the calibration that the solve found put in.

    With the calibration held at that, the poses and tags of the map are the least squares of these edges. What
    somebody measured by hand is not among them.

    Attributes:
        first: (M,) keyframe that a motion starts from, counted through all of the component's runs; the next ends it.
        motion: (M, 3) T_first_next by the wheels.
        motion_information: (M, 3, 3) of its right tangent (x, y, theta).
        pose: (N,) keyframe that a tag was read from, counted likewise.
        tag: (N,) index into the component's tags.
        place_m: (N, 2) of the tag in base.
        place_information: (N, 2, 2).
    """

    first: IntArray
    motion: FloatArray
    motion_information: FloatArray
    pose: IntArray
    tag: IntArray
    place_m: FloatArray
    place_information: FloatArray


@dataclass(frozen=True)
class FloorSigmas:
    """How far off level the base stands in each picture, as fitted to its corners; zeros on a level floor."""

    sigma_tilt_rad: float  # roll and pitch
    sigma_height_m: float


@dataclass(frozen=True)
class Component:
    """Runs and tags in one frame: the start of `frame_run`, which has no uncertainty."""

    frame_run: str
    runs: tuple[RunResult, ...]
    tags: tuple[TagResult, ...]
    # (3 R + 2 T, 3 R + 2 T): starts of `runs` in order as (x, y, theta), then `tags` in order as (x, y); map frame.
    joint_covariance: FloatArray
    cost: float  # half the sum of squared whitened residuals
    n_residuals: int
    start_to_start: tuple[StartToStart, ...] = ()
    edges: GraphEdges | None = None
    model: MapModel = MapModel.FLOOR
    calibration: ArchivedCalibration | None = None  # with its covariance, and that with the tags
    floor: FloorSigmas | None = None  # None where nobody looked at corners
    # By how many times all sigmas of the component are larger than computed; 1 where the model explains the drives.
    sigma_factor: float = 1.0
    misfit: Misfit | None = None  # what it does not explain

    @property
    def tag_covariance(self) -> FloatArray:
        """Joint covariance of all tags, (2 T, 2 T) in m^2."""
        n = 3 * len(self.runs)
        return self.joint_covariance[n:, n:]


@dataclass(frozen=True)
class AdviceResult:
    """One more drive or one more tag that would help the worst tag of a component.

    Attributes:
        kind: pass (drive that part of a run's way once more) or tag (hang one there and drive all as before).
        run: whose way it is, or beside whose way it hangs.
        tags: (family, tag id, instance) where the pass begins and ends; of a tag the one that hangs nearest.
        way_m: (N, 2) in map, of a tag (1, 2).
        length_m: of a pass; None for a tag.
        worst_tag: that has the largest sigma.
        sigma_m: that one, along its worst direction.
        sigma_then_m: the largest of any tag that is expected then.
    """

    kind: str
    component: int
    run: str
    tags: tuple[tuple[str, int, str], ...]
    way_m: FloatArray
    length_m: float | None
    worst_tag: tuple[str, int, str]
    sigma_m: float
    sigma_then_m: float


@dataclass(frozen=True)
class MapResult:
    """Everything that one `map` command found."""

    components: tuple[Component, ...]  # largest first
    alignments: tuple[AlignmentResult, ...]
    noise: NoiseParameters
    calibration: tuple[CalibrationResult, ...] = ()
    measurements: tuple[MeasurementResult, ...] = ()
    checks: tuple[ConsistencyCheck, ...] = ()
    metres: tuple[ScaleBudget, ...] = ()
    warnings: tuple[str, ...] = field(default=())
    losses: tuple[str, ...] = ()  # what of the logs cannot be read, a sentence each
    suspects: tuple[SuspectTag, ...] = ()
    noise_fit: FittedNoise | None = None  # None: the noise was given
    advice: tuple[AdviceResult, ...] = ()  # of each component in turn, the best first
    choices: tuple[CalibrationChoice, ...] = ()  # of self-calibration; none where it was off
    robot_numbers: tuple[RobotNumber, ...] = ()  # what the drives say of each number of robots' files
    kept: tuple[ArchivedSegment, ...] = ()  # each run's measurements, to solve them again together with another run's

    @property
    def runs(self) -> tuple[RunResult, ...]:
        """All runs of all components."""
        return tuple(run for component in self.components for run in component.runs)
