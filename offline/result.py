"""What mapping hands out: typed, in the map frame, in SI units.

A run with unbroken odometry is one chain; where the odometry broke, a run has several chains (stretches), named
`<run>` and `<run>_stretch2`, ... Each is placed on its own, like another run.
"""

from dataclasses import dataclass, field
from math import atan2
from pathlib import Path
from typing import Final

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.noise import NoiseParameters
from offline.kept import KeptCalibration, KeptChain
from offline.map_model import MapModel

# What is right goes beyond this once in 16,000 times.
MAX_SIGMAS: Final = 4.0


@dataclass(frozen=True)
class RunResult:
    """One chain of keyframes in its component's map frame."""

    name: str  # unique: robot id and run id, and the stretch where there are several
    run: str  # the run it belongs to: equal to name unless it is a later stretch
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

    @property
    def label(self) -> str:
        """Its number as people say it, with the instance."""
        return f"{self.tag_id}{self.instance}"

    @property
    def full_label(self) -> str:
        """The same with its family, for maps of several."""
        return f"{self.family}:{self.label}"


@dataclass(frozen=True)
class RivalResult:
    """Another transform that explains the shared tags almost as well."""

    T_from_to: FloatArray  # (3,)
    tags: tuple[tuple[str, int], ...]  # (family, tag id) of those that fit it


@dataclass(frozen=True)
class AlignmentResult:
    """Transform between two local maps, from the tags they share."""

    from_run: str
    to_run: str
    T_from_to: FloatArray  # (3,) pose of the second run's start in the first run's frame
    n_shared: int
    n_inliers: int
    inlier_rmse_m: float
    outliers: tuple[tuple[str, int], ...]  # (family, tag id) of shared tags that do not fit
    is_sure: bool = True  # else the runs are not joined by it: chance or a rival explains the tags almost as well
    rivals: tuple[RivalResult, ...] = ()
    is_weak: bool = False  # one tag alone joins them: if that was moved in between, nothing shows it
    # (3, 3) of T_from_to as x, y, theta in the first run's frame; None where the transform only begins a solve.
    covariance: FloatArray | None = None


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
    calibration: KeptCalibration | None = None  # with its covariance, and that with the tags
    floor: FloorSigmas | None = None  # None where nobody looked at corners

    @property
    def tag_covariance(self) -> FloatArray:
        """Joint covariance of all tags, (2 T, 2 T) in m^2."""
        n = 3 * len(self.runs)
        return self.joint_covariance[n:, n:]


@dataclass(frozen=True)
class SuspectTag:
    """A tag that does not belong.

    Attributes:
        kind: moved (between runs), moving (during one), swapped, duplicated (two tags with one id), phantom (a false
            detection) or inconsistent (its run has most of its tags elsewhere).
        runs: moved, swapped: in which it is not where it was first; moving: during which it was moved; duplicated:
            that saw it; phantom: with the false detections; inconsistent: the one that is wrong.
        evidence: in words, with numbers.
        swapped_with: the other tag's id.
    """

    family: str
    tag_id: int
    kind: str
    runs: tuple[str, ...]
    evidence: str
    swapped_with: int | None = None

    def line(self) -> str:
        """For a terminal."""
        return f"tag {self.tag_id} ({self.family}) {self.kind}: {self.evidence}"


@dataclass(frozen=True)
class CalibrationResult:
    """One calibration number that the solve carried, as a correction to what robot.yaml says."""

    owner: str  # robot id, or the printed batch of tags
    name: str  # wheel_scale, wheel_ratio, track_scale, mount_x_m, mount_y_m, mount_yaw_rad, tag_scale
    component: int
    value: float
    sigma: float
    prior_sigma: float


@dataclass(frozen=True)
class CalibrationChoice:
    """Whether self-calibration freed one number of robot.yaml, and why not.

    Attributes:
        owner: robot id, or the printed batch of tags.
        name: as in CalibrationResult.
        value: the correction by the drives alone, with its sigma.
        prior_sigma: what robot.yaml says of it.
        off_sigmas: how far drives and robot.yaml differ.
        held_out_gain: log likelihood of each stretch by what the other stretches tell, over that by robot.yaml; summed.
            None where no two stretches tell anything of it.
        reason: why it stays as robot.yaml has it; empty where it is freed.
        is_asked: it was asked for by its name.
    """

    owner: str
    name: str
    is_freed: bool
    value: float
    sigma: float
    prior_sigma: float
    off_sigmas: float
    held_out_gain: float | None
    reason: str
    is_asked: bool = False


@dataclass(frozen=True)
class MeasurementResult:
    """What a person measured, and what the map makes of it."""

    kind: str  # start or distance
    a: str  # the run whose start is the frame, or one end: a run, or family:id of a tag
    b: str  # the run, or the other end
    measured: FloatArray  # (3,) x_m, y_m, theta_rad in map, or (1,) metres
    sigma: FloatArray  # likewise
    component: int | None  # in which it was used; None: its ends are in different components
    in_map: FloatArray | None = None  # (3,) or (1,) as the map has it in the end
    residual_sigmas: float | None = None  # length of what is left over, whitened
    # How far it lies from what all else says, in sigmas of the difference; None where nothing else says anything.
    off_sigmas: float | None = None
    contradicts: bool = False  # by more than chance allows


@dataclass(frozen=True)
class CheckResult:
    """Two ways to know one thing, held against each other: wheels and tags."""

    name: str  # scale: how much longer a metre by the tags is than one by the wheels; turn: likewise a full turn
    component: int
    robot_id: str
    batch: str | None  # of tags; None for a turn, which needs no sizes
    value: float  # as a share, by readings alone: without the priors
    sigma: float
    prior_sigma: float  # how far the two may differ by what robot.yaml says

    @property
    def sigmas(self) -> float:
        """How far they differ, in sigmas of what readings and robot.yaml allow."""
        return abs(self.value) / float(np.hypot(self.sigma, self.prior_sigma))

    @property
    def contradicts(self) -> bool:
        """By more than chance allows."""
        return self.sigmas > MAX_SIGMAS


@dataclass(frozen=True)
class MetreResult:
    """What holds the length of a metre in a component: wheels, tags and all places could be stretched together."""

    component: int
    sigma: float  # relative
    shares: dict[str, float]  # of wheels, track, tags, mount, distances, starts; they add up to 1


@dataclass(frozen=True)
class FittedParameter:
    """One noise parameter, and what the runs told of it."""

    name: str  # as in NoiseParameters
    value: float
    low: float | None  # where it lies with 99 %; None where it was not fitted
    high: float | None
    redundancy: float  # of how many squared residuals of its own it is the mean
    kept: str = ""  # why it stands at its prior; empty where it was fitted


@dataclass(frozen=True)
class FittedNoise:
    """Where the noise comes from when nobody gave it."""

    parameters: tuple[FittedParameter, ...]
    shared_range: float  # variance that readings of a tag within 2.5 m of the way share, as a multiple of their own
    shared_bearing: float
    runs: tuple[str, ...]  # names of those that it was fitted to
    contradicting: tuple[str, ...]  # of those that contradict themselves: under the prior, or this where it is larger


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
    checks: tuple[CheckResult, ...] = ()
    metres: tuple[MetreResult, ...] = ()
    warnings: tuple[str, ...] = field(default=())
    losses: tuple[str, ...] = ()  # what of the logs cannot be read, a sentence each
    suspects: tuple[SuspectTag, ...] = ()
    noise_fit: FittedNoise | None = None  # None: the noise was given
    advice: tuple[AdviceResult, ...] = ()  # of each component in turn, the best first
    choices: tuple[CalibrationChoice, ...] = ()  # of self-calibration; none where it was off
    kept: tuple[KeptChain, ...] = ()  # each run's measurements, to solve them again together with another run's

    @property
    def runs(self) -> tuple[RunResult, ...]:
        """All runs of all components."""
        return tuple(run for component in self.components for run in component.runs)
