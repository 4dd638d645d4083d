"""Fleets for timing the solver: robots on a grid of roads, tags beside the roads, read by range and bearing.

No logs, pictures or calibration: only odometry and observations, as many as wanted, with the truth beside them.
"""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import fit_transform, se2
from groundsbot.calib.geometry.se2 import chain_motions
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    OdometryFactors,
    State,
    whitening,
)
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, solve

ROAD_M: Final = 6.0
STEP_M: Final = 0.25
TURN_STEPS: Final = 3  # for a quarter turn on the spot
TAG_OFFSET_M: Final = 1.2  # from the middle of the road: never driven through
REACH_M: Final = 4.0
NEAREST_M: Final = 0.3
HALF_VIEW_RAD: Final = np.radians(60.0)
READ_SHARE: Final = 0.5  # of the tags in view
SIGMA_MOTION: Final = np.array([0.01, 0.004, np.radians(0.25)])  # of one step
SIGMA_OBSERVATION: Final = np.array([0.05, np.radians(1.0)])
PIECE_M: Final = 10.0  # as `local_map` builds up a drive
PIECE_SHARE: Final = 0.01
PIECE_COST_TOLERANCE: Final = 1e-2
SIGMA_START: Final = np.array([0.3, 0.3, np.radians(5.0)])  # how well starts are known to begin with


@dataclass(frozen=True)
class Fleet:
    """A problem, what its measurements are of, and what dead reckoning makes of it."""

    problem: Problem
    truth: State
    dead_reckoned: State
    n_robots: int


def make_fleet(seed: int, n_robots: int, n_keyframes: int, n_tags: int, n_crossings: int | None = None) -> Fleet:
    """Robots that drive at random over roads with tags.

    Args:
        seed: of everything.
        n_robots: each one segment.
        n_keyframes: of each robot.
        n_tags: in the world; those that are never read are left out.
        n_crossings: along each side of the grid; as many as give tags every few metres where none is said.
    """
    rng = np.random.default_rng(seed)
    n_crossings = n_crossings or max(3, round(np.sqrt(n_tags / 3.0)) + 1)
    tags = place_tags(rng, n_crossings, n_tags)
    poses = np.concatenate([drive_at_random(rng, n_crossings, n_keyframes) for _ in range(n_robots)])
    first = np.flatnonzero(np.arange(len(poses)) % n_keyframes != n_keyframes - 1)
    motion, root = noisy_motion(rng, poses, first)
    pose, tag, value = observe(rng, poses, tags)
    seen, tag = np.unique(tag, return_inverse=True)
    truth = State(poses, tags[seen], np.zeros(1))
    problem = Problem(
        odometry=odometry_factors(first, motion, whitening(root @ root.swapaxes(-1, -2))),
        observations=observation_factors(pose, tag, value),
        prior=CalibrationPrior(np.zeros(1)),
        columns=columns_of(len(poses), len(seen)),
        anchor=middle_observations(pose, tag, len(seen)),
    )
    return Fleet(problem, truth, _dead_reckoned(rng, problem, truth, n_robots), n_robots)


def odometry_factors(first: IntArray, motion: FloatArray, roots: FloatArray) -> OdometryFactors:
    """Motions (M, 3) from poses (M,), without calibration; `roots` (M, 3, 3) whiten them."""
    n = len(first)
    return OdometryFactors(first, motion, roots, np.zeros((n, 3, 3)), np.zeros((n, 3), dtype=np.int64))


def observation_factors(pose: IntArray, tag: IntArray, value: FloatArray) -> ObservationFactors:
    """Ranges and bearings (M, 2) of tags from poses, without calibration."""
    n = len(pose)
    return ObservationFactors(
        pose, tag, value, np.ones(n, dtype=np.bool_), np.tile(np.diag(1.0 / SIGMA_OBSERVATION), (n, 1, 1)),
        np.zeros((n, 3)), np.zeros((n, 3), dtype=np.int64), np.zeros(n, dtype=np.int64),
        np.zeros((n, 2, len(CAMERA_PARAMETERS))), np.zeros((n, len(CAMERA_PARAMETERS)), dtype=np.int64), np.zeros(n),
    )  # fmt: skip


def place_tags(rng: np.random.Generator, n_crossings: int, n_tags: int) -> FloatArray:
    """(T, 2) beside roads, away from crossings."""
    along = ROAD_M * rng.integers(0, n_crossings - 1, n_tags) + rng.uniform(TAG_OFFSET_M, ROAD_M - TAG_OFFSET_M, n_tags)
    across = ROAD_M * rng.integers(0, n_crossings, n_tags) + TAG_OFFSET_M * rng.choice([-1.0, 1.0], n_tags)
    places = np.stack([along, across], axis=-1)
    return np.where(rng.random(n_tags)[:, None] < 0.5, places, places[:, ::-1])


def drive_at_random(rng: np.random.Generator, n_crossings: int, n_keyframes: int) -> FloatArray:
    """(K, 3) true poses of one robot: from crossing to crossing, turning on the spot."""
    steps = round(ROAD_M / STEP_M)
    place, quarter = rng.integers(0, n_crossings, 2), int(rng.integers(0, 4))
    ways = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    poses: list[FloatArray] = []
    while sum(len(part) for part in poses) < n_keyframes:
        free = [
            turn
            for turn in (0, 1, -1, 2)
            if ((place + ways[(quarter + turn) % 4]) % n_crossings == place + ways[(quarter + turn) % 4]).all()
        ]
        turn = int(rng.choice(free if len(free) == 1 else [t for t in free if t != 2]))
        heading = 0.5 * np.pi * (quarter + turn * np.arange(TURN_STEPS * abs(turn)) / max(1, TURN_STEPS * abs(turn)))
        poses.append(np.column_stack([np.tile(ROAD_M * place, (len(heading), 1)), heading]))
        quarter = (quarter + turn) % 4
        way = ROAD_M * (place + np.arange(steps)[:, None] / steps * ways[quarter])
        poses.append(np.column_stack([way, np.full(steps, 0.5 * np.pi * quarter)]))
        place = place + ways[quarter]
    driven = np.concatenate(poses)[:n_keyframes]
    driven[:, 2] = se2.wrap_angle(driven[:, 2])
    return driven


def noisy_motion(rng: np.random.Generator, poses: FloatArray, first: IntArray) -> tuple[FloatArray, FloatArray]:
    """Measured motions (M, 3), and roots (M, 3, 3) of their covariances, with correlations."""
    root = SIGMA_MOTION[:, None] * (np.eye(3) + 0.2 * np.tril(rng.standard_normal((len(first), 3, 3)), -1))
    error = np.einsum("nij,nj->ni", root, rng.standard_normal((len(first), 3)))
    return se2.compose(se2.between(poses[first], poses[first + 1]), se2.exp(error)), root


def observe(rng: np.random.Generator, poses: FloatArray, tags: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Poses, tags and (range, bearing), by rising pose."""
    found = []
    for first in range(0, len(poses), 2000):
        part = poses[first : first + 2000]
        seen = se2.apply(se2.inverse(part)[:, None], tags[None])
        range_m, bearing = np.hypot(seen[..., 0], seen[..., 1]), np.arctan2(seen[..., 1], seen[..., 0])
        in_view = (range_m < REACH_M) & (range_m > NEAREST_M) & (np.abs(bearing) < HALF_VIEW_RAD)
        pose, tag = np.nonzero(in_view & (rng.random(in_view.shape) < READ_SHARE))
        found.append((first + pose, tag, np.column_stack([range_m[pose, tag], bearing[pose, tag]])))
    pose, tag, value = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return pose, tag, value + SIGMA_OBSERVATION * rng.standard_normal(value.shape)


def columns_of(n_poses: int, n_tags: int) -> Columns:
    poses = np.arange(-3, 3 * n_poses - 3).reshape(n_poses, 3)
    poses[0] = -1
    n = 3 * n_poses - 3
    return Columns(poses, n + np.arange(2 * n_tags).reshape(n_tags, 2), np.full(1, -1), n + 2 * n_tags)


def middle_observations(pose: IntArray, tag: IntArray, n_tags: int) -> IntArray:
    order = np.argsort(tag, kind="stable")
    count = np.bincount(tag, minlength=n_tags)
    return np.asarray(pose[order[np.cumsum(count) - count + count // 2]])


def _dead_reckoned(rng: np.random.Generator, problem: Problem, truth: State, n_robots: int) -> State:
    """Motions one after the other from roughly known starts; tags where they were first read."""
    poses = []
    for robot, starts in enumerate(np.split(truth.poses, n_robots)):
        start = starts[0] if robot == 0 else se2.compose(starts[0], SIGMA_START * rng.standard_normal(3))
        n = len(starts)
        poses.append(chain_motions(problem.odometry.motion[robot * (n - 1) : (robot + 1) * (n - 1)], start))
    state = State(np.concatenate(poses), np.zeros_like(truth.tags), truth.calibration)
    _, first_observation = np.unique(problem.observations.tag, return_index=True)
    return State(state.poses, problem.observations.places_in_map(state)[first_observation], truth.calibration)


def joint_start(fleet: Fleet) -> State:
    """Return where the joint solve of `map` starts: drives solved alone, laid onto those before by shared tags."""
    n = len(fleet.truth.poses) // fleet.n_robots
    poses, places = [], np.full_like(fleet.truth.tags, np.nan)
    for robot in range(fleet.n_robots):
        own, tags = _built_up_drive(fleet, robot * n, n)
        shared = np.isfinite(places[tags, 0])
        T = fit_transform(places[tags[shared]], own.tags[shared]) if robot else fleet.truth.poses[0]
        poses.append(se2.compose(T, own.poses))
        places[tags[~shared]] = se2.apply(T, own.tags[~shared])
    return State(np.concatenate(poses), places, fleet.truth.calibration)


def _built_up_drive(fleet: Fleet, first: int, n: int) -> tuple[State, IntArray]:
    """One drive in the frame of its start, and the tags that it reads."""
    problem, known = fleet.problem, np.zeros((1, 3))
    motion = problem.odometry.motion[np.searchsorted(problem.odometry.first, first) :][: n - 1]
    along_m = np.append(0.0, np.cumsum(np.hypot(motion[:, 0], motion[:, 1])))
    places = np.zeros((0, 2))
    while True:
        last_m = along_m[len(known) - 1]
        end = int(np.searchsorted(along_m, last_m + max(PIECE_M, PIECE_SHARE * last_m))) + 1
        part, tags = _first_poses(problem, first, min(end, n))
        poses = np.concatenate(
            [known, chain_motions(motion[len(known) - 1 : len(part.columns.poses) - 1], known[-1])[1:]]
        )
        start = State(poses, np.zeros((len(tags), 2)), np.zeros(1))
        _, first_observation = np.unique(part.observations.tag, return_index=True)
        found = part.observations.places_in_map(start)[first_observation]
        found[: len(places)] = places
        solution = solve(part, State(poses, found, np.zeros(1)), PIECE_COST_TOLERANCE, PLAIN_SQUARES)
        known, places = solution.state.poses, solution.state.tags
        if len(known) == n:
            return solution.state, tags


def _first_poses(problem: Problem, first: int, n: int) -> tuple[Problem, IntArray]:
    """Return the first poses of a drive as a problem of its own, and the tags observed from them, first seen first."""
    steps = (problem.odometry.first >= first) & (problem.odometry.first < first + n - 1)
    read = (problem.observations.pose >= first) & (problem.observations.pose < first + n)
    own = problem.observations.tag[read]
    seen, at = np.unique(own, return_index=True)
    tags = seen[np.argsort(at)]
    index = np.full(len(problem.columns.tags), -1)
    index[tags] = np.arange(len(tags))
    odometry = {each.name: getattr(problem.odometry, each.name)[steps] for each in fields(problem.odometry)}
    observations = {each.name: getattr(problem.observations, each.name)[read] for each in fields(problem.observations)}
    pose = observations["pose"] - first
    return Problem(
        odometry=OdometryFactors(**{**odometry, "first": odometry["first"] - first}),
        observations=ObservationFactors(**{**observations, "pose": pose, "tag": index[own]}),
        prior=problem.prior,
        columns=columns_of(n, len(tags)),
        anchor=middle_observations(pose, index[own], len(tags)),
    ), tags
