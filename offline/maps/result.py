"""Results of mapping: typed, in the map frame, in SI units.

A run with unbroken odometry is one segment; a run with breaks has several segments, named `<run>` and `<run>_stretch2`,
... Each has a pose of its own, like another run.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import atan2
from pathlib import Path

from groundsbot.calib.foundation import FloatArray, IntArray, plural
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.maps.archive import ArchivedCalibration, ArchivedSegment
from groundsbot.offline.maps.datum import TagDatum
from groundsbot.offline.maps.fit_results import AlignmentResult, MeasurementResult, Misfit, OutlierTag
from groundsbot.offline.maps.lookup import find_run, find_tag
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
    run: str  # the run it belongs to: equal to `name` except for later segments
    log: Path
    robot_id: str
    run_id: str
    T_map_start: FloatArray  # (3,) x_m, y_m, theta_rad
    covariance: FloatArray  # (3, 3) of the start, map frame, (x, y, theta): m^2, m rad, rad^2
    stamps_ns: IntArray  # (K,)
    T_map_base: FloatArray  # (K, 3)
    distance_m: float  # driven, by the wheels
    # (7,) x, y, z in m and quaternion x, y, z, w: the camera with its estimated mount; None without a camera.
    T_base_camera: FloatArray | None = None
    # The same of each camera by name, where robot.yaml has several; the one above is then the first's.
    T_base_cameras: Mapping[str, FloatArray] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<RunResult {self.name}: {plural(self.n_keyframes, 'keyframe')}, {self.distance_m:.1f} m>"

    @property
    def n_keyframes(self) -> int:
        """Number of poses."""
        return len(self.stamps_ns)


@dataclass(frozen=True)
class TagPose:
    """Pose of one tag in space.

    Attributes:
        height_m: height of its centre above the floor.
        quaternion_xyzw: (4,) R_map_tag.
        covariance: (6, 6) of x, y, height and a small rotation about the map's axes: m^2, m rad, rad^2.
    """

    height_m: float
    quaternion_xyzw: FloatArray
    covariance: FloatArray

    @property
    def yaw_rad(self) -> float:
        """Direction of the face's normal on the floor."""
        x, y, z, w = self.quaternion_xyzw.tolist()
        return atan2(2.0 * (y * z - x * w), 2.0 * (x * z + y * w))


@dataclass(frozen=True)
class TagResult:
    """One tag in its component's map frame."""

    family: str
    tag_id: int
    instance: str  # empty unless several tags have the id: a, b, ...
    size_m: float | None  # None: imported positions
    position_m: FloatArray  # (2,)
    covariance: FloatArray  # (2, 2) m^2
    n_observations: int
    runs: tuple[str, ...]  # names of the runs that observed it
    pose: TagPose | None = None  # None if only its position on the floor is known
    # Scatter of its passes relative to its expectation, in sigmas; 1 if consistent. The covariance includes it.
    sigma_factor: float = 1.0

    def __repr__(self) -> str:
        x_m, y_m = self.position_m
        runs = plural(len(self.runs), "run")
        return (
            f"<TagResult {self.full_label} at ({x_m:.3f}, {y_m:.3f}) m: {plural(self.n_observations, 'observation')} "
            f"by {runs}>"
        )

    @property
    def label(self) -> str:
        """Id with the instance."""
        return f"{self.tag_id}{self.instance}"

    @property
    def full_label(self) -> str:
        """The label with its family, for maps with several."""
        return f"{self.family}:{self.label}"


@dataclass(frozen=True)
class StartToStart:
    """Vector from the start of one run to the start of another in one component."""

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
        """Standard deviation of the distance, first order; for a zero distance that of the worse axis."""
        distance_m = self.distance_m
        if distance_m < 1e-9:
            return float(max(self.covariance[0, 0], self.covariance[1, 1]) ** 0.5)
        direction = self.vector_m / distance_m
        return float((direction @ self.covariance @ direction) ** 0.5)


@dataclass(frozen=True)
class GraphEdges:
    """Odometry and observation factors of one component as edges of a pose graph, with the calibration fixed.

    The poses and tags of the map are the least-squares solution of these edges. Tape measurements (--start, --distance)
    are not among them. Keyframes are numbered from 0 through all runs of the component, in their order.

    Attributes:
        first: (M,) keyframe at which a motion starts; it ends at the next keyframe.
        motion: (M, 3) T_first_next (x_m, y_m, theta_rad), from wheels and gyro with the estimated calibration.
        motion_information: (M, 3, 3) information of the motion in its right tangent space (x, y, theta), in 1/m^2,
            1/(m rad) and 1/rad^2.
        pose: (N,) keyframe from which a tag was observed.
        tag: (N,) index into the component's tags.
        place_m: (N, 2) observed position of the tag in base.
        place_information: (N, 2, 2) information of the position in base, in 1/m^2.
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
    """Standard deviations of the base's tilt and height in each picture, fitted to corners; zeros on a level floor."""

    sigma_tilt_rad: float  # roll and pitch
    sigma_height_m: float


@dataclass(frozen=True)
class Component:
    """Runs and tags in one frame: the start of `frame_run`, which has no uncertainty, or one that tags hold."""

    frame_run: str | None  # None: `datum` is the frame
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
    floor: FloorSigmas | None = None  # None without corners
    # Factor by which all sigmas of the component were inflated; 1 if the model fits the drives.
    sigma_factor: float = 1.0
    misfit: Misfit | None = None  # lack of fit; None if the model fits
    datum: TagDatum | None = None  # the frame, if tags hold it
    converged: bool = True  # the solve; if not, the map is not to be used

    def __repr__(self) -> str:
        runs, tags = plural(len(self.runs), "run"), plural(len(self.tags), "tag")
        return f"<Component in the frame of {self.frame_owner}: {runs}, {tags}>"

    def tag(self, name: int | str) -> TagResult:
        """Return a tag by its id, by id and instance (`12a`), or by these with the family (`tag36h11:12`).

        Raises:
            UnknownNameError: the component has no such tag, or several.
        """
        return find_tag(self.tags, name)

    def run(self, name: str) -> RunResult:
        """Return a run by its name, or by its robot if that has one run only.

        Raises:
            UnknownNameError: the component has no such run, or several.
        """
        return find_run(self.runs, name)

    @property
    def frame_owner(self) -> str:
        """What the frame is of, for sentences: a run, the tags, two of them, or the survey."""
        return f"{self.frame_run}" if self.datum is None else self.datum.kind.owner(self._datum_labels())

    @property
    def frame_name(self) -> str:
        """The frame, for sentences."""
        return (
            f"the start of {self.frame_run}" if self.datum is None else self.datum.kind.frame_name(self._datum_labels())
        )

    @property
    def tag_covariance(self) -> FloatArray:
        """Joint covariance of all tags, (2 T, 2 T) in m^2."""
        n = 3 * len(self.runs)
        return self.joint_covariance[n:, n:]

    def _datum_labels(self) -> list[str]:
        """Return the labels of the tags that hold the frame."""
        weights = () if self.datum is None else self.datum.weights
        return [tag.label for tag, weight in zip(self.tags, weights, strict=True) if weight > 0.0]


@dataclass(frozen=True)
class AdviceResult:
    """One more drive or one more tag that would reduce the sigma of a component's worst tag.

    Sigmas are those relative to the other tags, without shift and turn of all together, where `of_shape`; else relative
    to the first start, as in maps of older programs, and with a single tag.

    Attributes:
        kind: pass (repeat that part of a run's path) or tag (mount one there and repeat all drives).
        run: run whose path it is, or whose path it is beside.
        tags: (family, tag id, instance) at which the pass begins and ends; for a tag the nearest one.
        way_m: (N, 2) in map, of a tag (1, 2).
        length_m: length of a pass; None for a tag.
        worst_tag: the one with the largest sigma.
        sigma_m: sigma of that one, along its worst direction.
        sigma_then_m: the largest expected of any tag afterwards.
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
    of_shape: bool = False


@dataclass(frozen=True)
class MapResult:
    """Results of one `map` command."""

    components: tuple[Component, ...]  # largest first
    alignments: tuple[AlignmentResult, ...]
    noise: NoiseParameters
    calibration: tuple[CalibrationResult, ...] = ()
    measurements: tuple[MeasurementResult, ...] = ()
    checks: tuple[ConsistencyCheck, ...] = ()
    scale_budgets: tuple[ScaleBudget, ...] = ()
    warnings: tuple[str, ...] = field(default=())
    losses: tuple[str, ...] = ()  # unreadable parts of the logs, a sentence each
    outliers: tuple[OutlierTag, ...] = ()
    noise_fit: FittedNoise | None = None  # None: the noise was given
    advice: tuple[AdviceResult, ...] = ()  # of each component in turn, the best first
    choices: tuple[CalibrationChoice, ...] = ()  # of self-calibration; none if it was off
    robot_numbers: tuple[RobotNumber, ...] = ()  # estimates of each number of robots' files
    archived_segments: tuple[
        ArchivedSegment, ...
    ] = ()  # each run's measurements, to solve them again jointly with another run's

    def __repr__(self) -> str:
        runs, tags = plural(len(self.runs), "run"), plural(len(self.tags), "tag")
        return f"<MapResult: {runs}, {tags}, {plural(len(self.components), 'component')}>"

    @property
    def runs(self) -> tuple[RunResult, ...]:
        """All runs of all components."""
        return tuple(run for component in self.components for run in component.runs)

    @property
    def tags(self) -> tuple[TagResult, ...]:
        """All tags of all components, each in the frame of its component."""
        return tuple(tag for component in self.components for tag in component.tags)

    def tag(self, name: int | str) -> TagResult:
        """Return a tag by its id, by id and instance (`12a`), or by these with the family (`tag36h11:12`).

        Raises:
            UnknownNameError: the map has no such tag, or several, be it in different components.
        """
        return find_tag(self.tags, name)

    def run(self, name: str) -> RunResult:
        """Return a run by its name, or by its robot if that has one run only.

        Raises:
            UnknownNameError: the map has no such run, or several.
        """
        return find_run(self.runs, name)
