"""Drives of robots as CSV files have them: speeds of wheels, ranges and bearings of tags, whose truth is known."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.geometry.se2 import chain_motions
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.offline.importing.robot import (
    NOMINAL_TRACK_M,
    RANGE_SCALE_SIGMA,
    SPEED_SCALE_SIGMA,
    ImportOptions,
    RobotDefaults,
    describe_robot,
)
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import Positions, TagKey
from tests.support.data.drives import FAMILY, START_NS, S, make_run

ROOM_M: Final = 8.0
STEP_S: Final = 0.1
STEPS: Final = 4  # of the wheels from picture to picture
# Ten tags of a room of eight by eight metres.
PLACES: Final[Mapping[int, tuple[float, float]]] = {
    0: (0.0, 1.3), 1: (0.0, 6.1), 2: (2.3, 8.0), 3: (5.9, 8.0), 4: (8.0, 6.6), 5: (8.0, 2.2), 6: (6.2, 0.0),
    7: (2.9, 0.0), 8: (3.1, 4.4), 9: (5.4, 3.3),
}  # fmt: skip


NOISE: Final = NoiseParameters(
    sigma_distance_m_per_sqrt_m=0.01,
    sigma_lateral_m_per_sqrt_m=0.005,
    sigma_heading_rad_per_sqrt_m=0.01,
    sigma_heading_rad_per_sqrt_rad=0.02,
    sigma_range_m=0.02,
    sigma_range_per_m=0.01,
    sigma_bearing_rad=0.01,
    sigma_stamp_s=0.002,
)


@dataclass(frozen=True)
class Truth:
    """What is true of a robot.

    Attributes:
        distance: ln(true distance / distance by the wheels).
        turn_left, turn_right: relative excess of true turns over those by the wheels.
        wheel_ratio: turn per metre by the wheels, in rad/m, times the track.
        turn_loss: distance lost per turn, in m/rad, times the share of the base's travel in that of the outer wheel.
        mount: pose (x_m, y_m, yaw_rad) of the sensor in base.
        delay_s: of the readings' stamps.
        offset_m: excess of ranges; range_scale: its logarithm's; depth: exponent of the bearing's cosine.
        noise: scales of errors, which all have tails with four degrees of freedom.
    """

    distance: float = 0.0
    turn_left: float = 0.0
    turn_right: float = 0.0
    wheel_ratio: float = 0.0
    turn_loss: float = 0.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay_s: float = 0.0
    offset_m: float = 0.0
    range_scale: float = 0.0
    depth: float = 0.0
    noise: NoiseParameters = NOISE


PLAIN: Final = Truth()


@dataclass(frozen=True)
class Fault:
    """What goes wrong in a drive.

    Attributes:
        turned_at_s, turned_rad: a turn on the spot that the wheels do not tell.
        called: number of successive readings of a tag under another's id: (tag, id, how many, from which on).
        exchanged: two tags with each other's id.
    """

    turned_at_s: float = -1.0
    turned_rad: float = 0.0
    called: tuple[int, int, int, int] | None = None
    exchanged: tuple[int, int] | None = None


NO_FAULT: Final = Fault()


@dataclass(frozen=True)
class MadeDrive:
    """A drive, and its true poses (N, 3) in the world at the wheels' stamps."""

    run: Run
    T_world_base: FloatArray
    places: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    def at(self, stamps_ns: IntArray) -> FloatArray:
        """True poses (K, 3), by constant twists between wheel readings."""
        return _at(self.run.wheel_segments[0].stamps_ns, self.T_world_base, stamps_ns)

    @property
    def segment(self) -> Segment:
        (segment,) = segments_of(self.run, NoiseParameters())
        return segment


def _at(known_ns: IntArray, poses: FloatArray, stamps_ns: IntArray) -> FloatArray:
    after = np.clip(np.searchsorted(known_ns, stamps_ns), 1, len(known_ns) - 1)
    fraction = (stamps_ns - known_ns[after - 1]) / (known_ns[after] - known_ns[after - 1])
    return se2.interpolate(poses[after - 1], poses[after], fraction)


def imported_robot(robot_id: str) -> Robot:
    """As `import` makes one of a folder with speeds and ranges, without options."""
    known = RobotDefaults(needs_track=False, wheel_scale_sigma=SPEED_SCALE_SIGMA, range_scale_sigma=RANGE_SCALE_SIGMA)
    return describe_robot(Path(robot_id), ImportOptions(robot_id=robot_id), in_camera=True, known=known)[0]


def make_drive(
    name: str,
    seed: int,
    seconds: float = 150.0,
    truth: Truth = PLAIN,
    places: Mapping[int, tuple[float, float]] = PLACES,
    fault: Fault = NO_FAULT,
    *,
    xy: bool = False,
    most_m: float = 4.0,
    widest_rad: float = 1.0,
    robot: Robot | None = None,
) -> MadeDrive:
    """A drive to points of the room at random, that reads the tags ahead from picture to picture.

    Args:
        name: of the robot.
        seed: of the way and of the noise.
        seconds: how long.
        truth: of the robot.
        places: of tags in the world, by id.
        fault: what goes wrong.
        xy: readings are places in the sensor's axes, with a covariance, instead of ranges and bearings.
        most_m, widest_rad: where tags are read.
        robot: its file; by default as imported.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    wheels, poses = _drive(rng, seconds, truth, fault)
    stamps_ns, tag_ids, value = _readings(rng, wheels.stamps_ns, poses, truth, places, most_m, widest_rad)
    ids = _called(tag_ids, fault)
    known = sorted({*ids.tolist()})
    n = len(ids)
    covariance = np.full((n, 2, 2), np.nan)
    if xy:
        ahead = np.stack([np.cos(value[:, 1]), np.sin(value[:, 1])], axis=-1)
        value, covariance = value[:, :1] * ahead, np.tile(0.02**2 * np.eye(2), (n, 1, 1))
    positions = Positions(
        stamps_ns, np.searchsorted(known, ids), value, np.full(n, not xy), covariance, np.ones(n, dtype=np.bool_)
    )
    run = make_run(
        [wheels],
        robot=robot or imported_robot(name),
        camera=None,
        tags=[TagKey(FAMILY, each) for each in known],
        positions=positions,
    )
    return MadeDrive(replace(run, log=Path("logs") / name), poses, places)


def _drive(rng: np.random.Generator, seconds: float, truth: Truth, fault: Fault) -> tuple[WheelSegment, FloatArray]:
    """The wheels' readings and true poses.

    The way to a point is planned where the one before ends, and driven blindly: what the wheels do must not answer to
    the errors of motions. The error of a motion from picture to picture is drawn once.
    """
    n = round(seconds / STEP_S / STEPS)
    T_world_base = np.array([4.0, 2.0, float(rng.uniform(-np.pi, np.pi))])
    u = rng.standard_normal((n, 3)) * np.sqrt(4.0 / rng.chisquare(4.0, (n, 3)))
    steps, poses = [np.zeros((0, 2))], [T_world_base[None]]
    plan = np.zeros((0, 2))
    for k in range(n):
        if not len(plan):
            plan = _plan(rng.uniform(1.0, ROOM_M - 1.0, 2) - T_world_base[:2], T_world_base[2])
        own, plan = plan[:STEPS], plan[STEPS:]
        steps.append(own)
        poses.append(chain_motions(_true_motions(own, truth, u[k]), T_world_base)[1:])
        if 0.0 < fault.turned_at_s <= (k + 1) * STEPS * STEP_S:
            poses[-1][-1, 2] += fault.turned_rad
            fault = NO_FAULT
        T_world_base = poses[-1][-1]
    d, phi = np.concatenate(steps).T
    stamps_ns = START_NS + round(STEP_S * S) * np.arange(len(d) + 1, dtype=np.int64)
    left_m, right_m = (np.append(0.0, np.cumsum(d + side * 0.5 * NOMINAL_TRACK_M * phi)) for side in (-1.0, 1.0))
    return WheelSegment(stamps_ns, left_m, right_m), np.concatenate(poses)


def _true_motions(steps: FloatArray, truth: Truth, u: FloatArray) -> FloatArray:
    """What some steps (n, 2) of the wheels, in metres and radians, really are, off by u (3,) scales of the noise."""
    noise, (d, phi) = truth.noise, steps.T
    by_place = float((d + 0.1 * np.abs(phi)).sum())
    by_heading = noise.sigma_heading_rad_per_sqrt_m**2 * float(d.sum())
    by_heading += noise.sigma_heading_rad_per_sqrt_rad**2 * float(np.abs(phi).sum())
    along_m, across_m = (
        sigma * np.sqrt(by_place) for sigma in (noise.sigma_distance_m_per_sqrt_m, noise.sigma_lateral_m_per_sqrt_m)
    )
    turn = phi * (1.0 + np.where(phi > 0.0, truth.turn_left, truth.turn_right))
    turn += d / NOMINAL_TRACK_M * truth.wheel_ratio
    off = np.array([along_m, across_m, np.sqrt(by_heading)]) * u / len(steps)
    lost = truth.turn_loss * np.abs(phi) * d / (d + 0.5 * NOMINAL_TRACK_M * np.abs(phi))
    ahead = np.stack([d - lost + off[0], np.full(len(d), off[1]), turn + off[2]], axis=-1)
    return np.asarray(se2.exp(ahead * [np.exp(truth.distance), np.exp(truth.distance), 1.0]))


def _plan(way_m: FloatArray, theta_rad: float) -> FloatArray:
    """Steps (n, 2) of metres and radians by the wheels: a turn, then a way that winds about the straight one."""
    turn_rad = float(se2.wrap_angle(np.arctan2(way_m[1], way_m[0]) - theta_rad))
    n_turn, n_way = (STEPS * (int(each / STEPS) + 1) for each in (abs(turn_rad) / 0.08, np.hypot(*way_m) / 0.04))
    turning = np.append(np.full(n_turn, turn_rad / n_turn), 0.05 * np.cos(2.0 * np.pi * np.arange(n_way) / 30.0))
    return np.stack([np.append(np.full(n_turn, 0.01), np.full(n_way, 0.04)), turning], axis=-1)


def _readings(
    rng: np.random.Generator,
    known_ns: IntArray,
    poses: FloatArray,
    truth: Truth,
    places: Mapping[int, tuple[float, float]],
    most_m: float,
    widest_rad: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Stamps, ids, and ranges with bearings; a picture is taken each few steps of the wheels."""
    noise, delay_ns = truth.noise, round(truth.delay_s * S)
    taken_ns = known_ns[::STEPS][1:-2]
    ids, at = np.array(sorted(places)), np.array([places[each] for each in sorted(places)])
    shape = len(taken_ns), len(ids)
    tails, u = np.sqrt(4.0 / rng.chisquare(4.0, shape)), rng.standard_normal((3, *shape))
    late_s = noise.sigma_stamp_s * tails * u[2]
    base = _at(known_ns, poses, (taken_ns[:, None] - np.rint(late_s * S).astype(np.int64)).reshape(-1))
    x, y, yaw = se2.compose(base, np.array(truth.mount)).T.reshape(3, *shape)
    rho, beta = np.hypot(at[:, 0] - x, at[:, 1] - y), se2.wrap_angle(np.arctan2(at[:, 1] - y, at[:, 0] - x) - yaw)
    range_m = np.exp(truth.range_scale) * rho * np.maximum(np.cos(beta), 0.1) ** truth.depth + truth.offset_m
    which, tag = np.nonzero((rho < most_m) & (rho > 0.3) & (np.abs(beta) < widest_rad))
    range_m += np.hypot(noise.sigma_range_m, noise.sigma_range_per_m * range_m) * tails * u[0]
    bearing_rad = beta + noise.sigma_bearing_rad * tails * u[1]
    return taken_ns[which] + delay_ns, ids[tag], np.stack([range_m, bearing_rad], axis=-1)[which, tag]


def _called(tag_ids: IntArray, fault: Fault) -> IntArray:
    """The ids under which tags are read."""
    ids = tag_ids.copy()
    if fault.exchanged is not None:
        a, b = fault.exchanged
        ids = np.where(tag_ids == a, b, np.where(tag_ids == b, a, ids))
    if fault.called is not None:
        tag, other, n, first = fault.called
        ids[np.flatnonzero(tag_ids == tag)[first : first + n]] = other
    return ids


class Fit(NamedTuple):
    """Places fitted to true ones: the true ones are turned by `turn` and stretched by `scale`, then moved.

    Attributes:
        turn: (2, 2)
        centre_m, true_centre_m: (2,) mean of the places.
        rms_m: what is left, in true metres.
    """

    turn: FloatArray
    scale: float
    centre_m: FloatArray
    true_centre_m: FloatArray
    rms_m: float

    def errors_m(self, places_m: FloatArray, true_m: FloatArray) -> FloatArray:
        """(n,) by how far other places (n, 2) of the same frame are off true ones (n, 2)."""
        turned = (true_m - self.true_centre_m) @ self.turn.T
        return np.asarray(np.hypot(*((places_m - self.centre_m) / self.scale - turned).T))


def fit(places_m: FloatArray, true_m: FloatArray) -> Fit:
    centre_m, true_centre_m = places_m.mean(axis=0), true_m.mean(axis=0)
    places, true = places_m - centre_m, true_m - true_centre_m
    U, _, V = np.linalg.svd(places.T @ true)
    turn = U @ np.diag([1.0, np.linalg.det(U @ V)]) @ V
    turned = true @ turn.T
    scale = float((places * turned).sum() / (turned**2).sum())
    rms_m = float(np.sqrt(((places / scale - turned) ** 2).sum(axis=1).mean()))
    return Fit(turn, scale, centre_m, true_centre_m, rms_m)
