"""Long drives past few tags: a town of long roads, driven at random, whose dead reckoning ends somewhere else.

No logs and no pictures: a segment as `map` makes it from a run, with the truth beside it.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import Positions, TagKey
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import Graph
from tests.support.data.drives import FAMILY, START_NS, S, make_robot, make_run

ROAD_M: Final = 25.0
N_CROSSINGS: Final = 5  # along each side of the town
TURN_ROUND_SHARE: Final = 0.1  # of the crossings: back the way it came
TAG_SPACING_M: Final = (10.0, 30.0)
TAG_OFFSET_M: Final = 1.5  # from the middle of the road
REACH_M: Final = (0.5, 5.0)
HALF_VIEW_RAD: Final = np.radians(40.0)
READ_SHARE: Final = 0.7  # of the pictures with a tag in view
STEP_M: Final = 0.05  # between wheel readings
STEP_RAD: Final = np.radians(5.0)
STEP_NS: Final = S // 20
MESSAGE_BYTES: Final = 50  # simulated logs have 57 for each message
SIGMA_OBSERVATION: Final = np.array([0.05, np.radians(1.0)])
# A heading that wanders by a right angle over a kilometre: soft tyres, carpets.
NOISE: Final = NoiseParameters(sigma_heading_rad_per_sqrt_m=np.radians(2.0))
# How much larger or smaller the noise truly is than the estimate is given, each kind independently.
NOISE_FACTORS: Final = (0.7, 1.4)
_WAYS: Final = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


@dataclass(frozen=True)
class Town:
    """What drives of one town share.

    Attributes:
        tags_m: (T, 2) by tag id.
        tag_scale: of the batch that all tags were printed in.
        n_crossings: along each side.
        tag_ids: (T,) where they are not the numbers of the rows.
        there: (T, 2) between which shares of a drive each tag is there, where not all of the time.
    """

    tags_m: FloatArray
    tag_scale: float
    n_crossings: int = N_CROSSINGS
    tag_ids: IntArray | None = None
    there: FloatArray | None = None


@dataclass(frozen=True)
class LongDrive:
    """A segment, and what its measurements are of, in the frame of its start."""

    segment: Segment
    T_start_base: FloatArray  # (K, 3)
    tags_m: dict[TagKey, FloatArray]
    calibration: dict[str, float]
    T_town_start: FloatArray  # (3,)

    def true_state(self, graph: Graph) -> State:
        """As variables of the segment's own graph."""
        return State(
            self.T_start_base,
            np.array([self.tags_m[tag] for tag in graph.tags]).reshape(-1, 2),
            np.array([self.calibration.get(parameter.name, 0.0) for parameter in graph.parameters]),
        )


def make_long_drive(
    seed: int,
    length_m: float = 1000.0,
    picture_every: int = 5,
    radius_sigma: float | None = None,
    *,
    town: Town | None = None,
    noise: NoiseParameters = NOISE,
    noise_factors: tuple[float, float] = NOISE_FACTORS,
) -> LongDrive:
    """A robot that drives at random from crossing to crossing, past tags 10 to 30 m apart.

    Calibration is off by draws from what its robot.yaml allows, and motions and observations by the noise that the
    estimate is given, times a factor that it is not given.

    Args:
        seed: of everything.
        length_m: driven, to the next crossing.
        picture_every: so many steps of 5 cm or 5 degrees.
        radius_sigma: the relative one of each wheel; robot.yaml's default where None.
        town: a town of its own where None; a robot of its own where given.
        noise: of the wheels, as the estimate is given it.
        noise_factors: the least and the most that the true noise is of that.
    """
    rng = np.random.default_rng(seed)
    robot = _robot(radius_sigma, "carl" if town is None else f"carl{seed}")
    driven = _drive(rng, length_m, N_CROSSINGS if town is None else town.n_crossings)
    poses = se2.compose(se2.inverse(driven[0]), driven)
    stamps_ns = START_NS + STEP_NS * np.arange(len(poses), dtype=np.int64)
    placed = _placed_tags(rng, TAG_SPACING_M) if town is None else town.tags_m
    tags_m = se2.apply(se2.inverse(driven[0]), placed)
    calibration = _drawn_calibration(rng, robot)
    if town is not None:
        calibration["tag_scale"] = town.tag_scale
    odometry_factor, observation_factor = noise_factors[0] * (noise_factors[1] / noise_factors[0]) ** rng.random(2)
    pictures = np.arange(0, len(poses), picture_every)
    picture, tag, value = _observations(rng, poses[pictures], tags_m, robot, calibration, observation_factor)
    ids = np.arange(len(placed))
    if town is not None:
        ids = ids if town.tag_ids is None else town.tag_ids
        shown = _is_there(town, tag, picture / len(pictures))
        picture, tag, value = picture[shown], tag[shown], value[shown]
    row_of = tag
    seen, first, tag = np.unique(ids[tag], return_index=True, return_inverse=True)
    keys = tuple(TagKey(FAMILY, int(i)) for i in seen)
    n = len(picture)
    positions = Positions(
        stamps_ns[pictures[picture]], tag, value, np.ones(n, dtype=np.bool_),
        np.tile(np.diag(SIGMA_OBSERVATION**2), (n, 1, 1)), np.ones(n, dtype=np.bool_),
    )  # fmt: skip
    track = _wheel_track(stamps_ns, poses, robot, calibration)
    run = make_run([track], robot=robot, camera=None, tags=keys, pictures_ns=stamps_ns[pictures], positions=positions)
    (segment,) = segments_of(replace(run, log_bytes=MESSAGE_BYTES * (len(stamps_ns) + len(pictures))), noise)
    return LongDrive(
        _with_noise(rng, segment, odometry_factor),
        poses[np.searchsorted(stamps_ns, segment.stamps_ns)],
        dict(zip(keys, tags_m[row_of[first]], strict=True)),
        calibration,
        driven[0],
    )


def with_drifting_observations(segment: Segment, sigmas: float, length_m: float, seed: int) -> Segment:
    """Ranges of each tag err besides by so many sigmas that neighbours share: correlated as exp(-way / length)."""
    observations = segment.observations
    along_m = np.append(0.0, np.cumsum(segment.odometry.distance_m))[observations.keyframe]
    drawn = np.random.default_rng(seed).standard_normal(len(along_m))
    drift = np.zeros(len(along_m))
    for tag in range(len(segment.tags)):
        of_tag = np.flatnonzero(observations.tag == tag)
        kept = np.exp(-np.diff(along_m[of_tag], prepend=-np.inf) / length_m)
        last = 0.0
        for i, share in zip(of_tag, kept, strict=True):
            drift[i] = last = share * last + np.sqrt(1.0 - share**2) * drawn[i]
    value = observations.value.copy()
    value[:, 0] += sigmas * np.sqrt(observations.covariance[:, 0, 0]) * drift
    return replace(segment, observations=replace(observations, value=value))


def with_a_moved_tag(drive: LongDrive, segment: Segment | None = None) -> Segment:
    """The tag with most observations is 2.8 m farther on when seen again; in this segment, or one made of it."""
    segment = drive.segment if segment is None else segment
    observations = segment.observations
    tag = int(np.argmax(np.bincount(observations.tag)))
    tracks = observations.keyframe[observations.tag == tag]
    later = (observations.tag == tag) & (observations.keyframe > tracks[np.argmax(np.diff(tracks))])
    camera = se2.compose(drive.T_start_base[observations.keyframe[later]], segment.T_base_sensor[0])
    place = se2.apply(se2.inverse(camera), drive.tags_m[segment.tags[tag]] + 2.0)
    value = observations.value.copy()
    value[later] = np.column_stack([np.hypot(*place.T), np.arctan2(place[:, 1], place[:, 0])])
    return replace(segment, observations=replace(observations, value=value))


def make_town(seed: int, spacing_m: tuple[float, float] = TAG_SPACING_M, n_crossings: int = N_CROSSINGS) -> Town:
    """Roads with tags so far apart, and their batch a draw from its prior."""
    rng = np.random.default_rng(seed)
    placed = _placed_tags(rng, spacing_m, n_crossings)
    return Town(placed, make_robot().tags[0].relative_sigma * float(rng.standard_normal()), n_crossings)


def _is_there(town: Town, tag: IntArray, share: FloatArray) -> BoolArray:
    """(M,) whether each tag read is there after that share of the drive."""
    if town.there is None:
        return np.ones(len(tag), dtype=np.bool_)
    return np.asarray((town.there[tag, 0] <= share) & (share < town.there[tag, 1]))


def _robot(radius_sigma: float | None, robot_id: str) -> Robot:
    robot = make_robot(robot_id)
    if radius_sigma is None:
        return robot
    wheels_section = robot.wheels.model_copy(
        update={
            "radius_left_m_sigma": radius_sigma * robot.wheels.radius_left_m,
            "radius_right_m_sigma": radius_sigma * robot.wheels.radius_right_m,
        }
    )
    return robot.model_copy(update={"wheels": wheels_section})


def _drive(rng: np.random.Generator, length_m: float, n_crossings: int) -> FloatArray:
    """(N, 3) true poses at the wheel readings: along roads, turning on the spot."""
    place, way = rng.integers(0, n_crossings, 2), int(rng.integers(0, 4))
    turns, steps = round(0.5 * np.pi / STEP_RAD), round(ROAD_M / STEP_M)
    poses: list[FloatArray] = [np.r_[ROAD_M * place, 0.5 * np.pi * way][None]]
    for _ in range(round(length_m / ROAD_M)):
        free = [turn for turn in (0, 1, -1, 2) if _is_crossing(place + _WAYS[(way + turn) % 4], n_crossings)]
        onward = [turn for turn in free if turn != 2]
        turn = 2 if 2 in free and (not onward or rng.random() < TURN_ROUND_SHARE) else int(rng.choice(onward))
        heading = 0.5 * np.pi * way + np.sign(turn) * STEP_RAD * np.arange(1, abs(turn) * turns + 1)
        poses.append(np.column_stack([np.tile(ROAD_M * place, (len(heading), 1)), heading]))
        way = (way + turn) % 4
        along = STEP_M * np.arange(1, steps + 1)[:, None] * _WAYS[way]
        poses.append(np.column_stack([ROAD_M * place + along, np.full(steps, 0.5 * np.pi * way)]))
        place = place + _WAYS[way]
    driven = np.concatenate(poses)
    driven[:, 2] = se2.wrap_angle(driven[:, 2])
    return driven


def _is_crossing(place: IntArray, n_crossings: int) -> bool:
    return bool(((place >= 0) & (place < n_crossings)).all())


def _placed_tags(
    rng: np.random.Generator, spacing_m: tuple[float, float], n_crossings: int = N_CROSSINGS
) -> FloatArray:
    """(T, 2) beside the roads, now left, now right."""
    tags = []
    for across in range(n_crossings):
        for along_x in (True, False):
            along_m = rng.uniform(0.0, spacing_m[1])
            while along_m < ROAD_M * (n_crossings - 1):
                place = np.array([along_m, ROAD_M * across + TAG_OFFSET_M * rng.choice([-1.0, 1.0])])
                tags.append(place if along_x else place[::-1])
                along_m += rng.uniform(*spacing_m)
    return np.array(tags)


def _drawn_calibration(rng: np.random.Generator, robot: Robot) -> dict[str, float]:
    """By name of the parameter: two wheels, the track, the mount and the tags, each a draw from its prior."""
    made = robot.wheels
    left = made.radius_left_m_sigma / made.radius_left_m * rng.standard_normal()
    right = made.radius_right_m_sigma / made.radius_right_m * rng.standard_normal()
    mount, batch = robot.mount, robot.tags[0]
    return {
        "wheel_scale": 0.5 * (left + right),
        "wheel_ratio": right - left,
        "track_scale": made.track_m_sigma / made.track_m * rng.standard_normal(),
        "mount_x_m": mount.x_m_sigma * rng.standard_normal(),
        "mount_y_m": mount.y_m_sigma * rng.standard_normal(),
        "mount_yaw_rad": mount.yaw_rad_sigma * rng.standard_normal(),
        "tag_scale": batch.relative_sigma * rng.standard_normal(),
    }


def _wheel_track(stamps_ns: IntArray, poses: FloatArray, robot: Robot, calibration: dict[str, float]) -> WheelSegment:
    """What the wheels count by their nominal radii."""
    moved = se2.log(se2.between(poses[:-1], poses[1:]))
    half_turn_m = 0.5 * robot.wheels.track_m * (1.0 + calibration["track_scale"]) * moved[:, 2]
    scale, half_ratio = 1.0 + calibration["wheel_scale"], 0.5 * calibration["wheel_ratio"]
    left_m = np.cumsum(moved[:, 0] - half_turn_m) / (scale * (1.0 - half_ratio))
    right_m = np.cumsum(moved[:, 0] + half_turn_m) / (scale * (1.0 + half_ratio))
    return WheelSegment(stamps_ns, np.r_[0.0, left_m], np.r_[0.0, right_m])


def _observations(
    rng: np.random.Generator,
    poses: FloatArray,
    tags_m: FloatArray,
    robot: Robot,
    calibration: dict[str, float],
    factor: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pose, tag and (range, bearing) about the camera of each observation."""
    off = np.array([calibration[name] for name in ("mount_x_m", "mount_y_m", "mount_yaw_rad")])
    mount = np.array([robot.mount.x_m, robot.mount.y_m, robot.mount.yaw_rad]) + off
    place = se2.apply(se2.inverse(se2.compose(poses, mount))[:, None], tags_m[None])
    place /= 1.0 + calibration["tag_scale"]
    range_m, bearing_rad = np.hypot(place[..., 0], place[..., 1]), np.arctan2(place[..., 1], place[..., 0])
    in_view = (range_m > REACH_M[0]) & (range_m < REACH_M[1]) & (np.abs(bearing_rad) < HALF_VIEW_RAD)
    pose, tag = np.nonzero(in_view & (rng.random(in_view.shape) < READ_SHARE))
    value = np.column_stack([range_m[pose, tag], bearing_rad[pose, tag]])
    return pose, tag, value + factor * SIGMA_OBSERVATION * rng.standard_normal(value.shape)


def _with_noise(rng: np.random.Generator, segment: Segment, factor: float) -> Segment:
    odometry = segment.odometry
    root = factor * np.linalg.cholesky(odometry.covariance)
    error = np.einsum("nij,nj->ni", root, rng.standard_normal((len(root), 3)))
    return replace(segment, odometry=replace(odometry, motion=se2.compose(odometry.motion, se2.exp(error))))
