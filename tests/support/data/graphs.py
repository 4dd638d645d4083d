"""Random graphs long enough to be cut into nested pieces, with every kind of factor and all calibration."""

from dataclasses import fields, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    OdometryFactors,
    State,
    whitening,
)
from groundsbot.offline.sam.factors.priors import DistanceFactors, Priors, StartFactors
from groundsbot.offline.sam.solver import Problem
from tests.support.data.factors import observations_of, odometry_of

_ROBOT_SIGMA: Final = (0.004, 0.007, *(0.01,) * (4 + len(CAMERA_PARAMETERS)))  # wheels, mount, what else of the camera
_OF_ROBOT: Final = len(_ROBOT_SIGMA)
_BATCH_SIGMA: Final = (0.005, 0.005)


def make_graph(
    seed: int,
    lengths: list[int],
    n_tags: int,
    *,
    calibrated: bool = True,
    reach: float = 0.3,
    held: float = 0.0,
    n_robots: int = 2,
) -> tuple[Problem, State]:
    """A problem and the state that its measurements are of, but for their noise.

    Args:
        seed: of everything.
        lengths: poses of each segment; robots take turns.
        n_tags: each read along some part of the first segment, and of others.
        calibrated: calibration is free, else it is held.
        reach: the longest share of a segment along which a tag is read.
        held: share of the other poses' directions, and of the tags, that are held like the first pose.
        n_robots: number of robots.
    """
    rng = np.random.default_rng(seed)
    sigma = np.r_[0.0, _ROBOT_SIGMA * n_robots, _BATCH_SIGMA] * (1.0 if calibrated else 0.0)
    poses, first, segment_of = _drive(rng, lengths)
    robot_of = segment_of % n_robots
    truth = State(poses, rng.uniform(-4.0, 4.0, (n_tags, 2)), sigma * _draw(rng, n_robots))
    observations = _observations(rng, truth, lengths, robot_of, reach)
    problem = Problem(
        odometry=_odometry(rng, truth, first, robot_of),
        observations=observations,
        prior=CalibrationPrior(sigma),
        columns=_columns(rng, len(poses), n_tags, sigma > 0.0, held),
        anchor=observations.pose[np.unique(observations.tag, return_index=True)[1]],
    )
    return problem, truth


def _draw(rng: np.random.Generator, n_robots: int) -> FloatArray:
    """Calibration in sigmas; of each robot all but nine numbers by a generator of their own."""
    others = rng.standard_normal(1 + n_robots * 9 + len(_BATCH_SIGMA))
    at = np.tile([1 + (i + 1) * 9 for i in range(n_robots)], _OF_ROBOT - 9)
    drawn: FloatArray = np.insert(others, at, rng.spawn(1)[0].standard_normal(len(at)))
    return drawn


def reorder(problem: Problem, rng: np.random.Generator) -> Problem:
    """The same with the observations in another order."""
    order = rng.permutation(len(problem.observations.pose))
    observations = problem.observations
    mixed = ObservationFactors(
        *(getattr(observations, name)[order] for name in (field.name for field in fields(ObservationFactors)))
    )
    return Problem(problem.odometry, mixed, problem.prior, problem.columns, problem.anchor)


def with_measured(problem: Problem, truth: State, seed: int, n: int) -> Problem:
    """The same with up to n measured starts and n distances, of any two ends: first poses of segments, or tags."""
    rng = np.random.default_rng(seed)
    n_poses, n_tags = len(truth.poses), len(truth.tags)
    firsts = np.setdiff1d(np.arange(n_poses), problem.odometry.first + 1)
    at = rng.integers(0, n_poses, n)
    root = 0.1 * (np.eye(3) + 0.3 * rng.standard_normal((n, 3, 3)))
    starts = StartFactors(
        at, se2.compose(truth.poses[at], 0.1 * rng.standard_normal((n, 3))), whitening(root @ root.swapaxes(1, 2))
    )
    ends = np.array([rng.permutation(len(firsts) + n_tags)[:2] for _ in range(n)], dtype=np.int64).reshape(-1, 2).T
    pose = np.where(ends < len(firsts), firsts[np.minimum(ends, len(firsts) - 1)], -1)
    tag = np.where(ends < len(firsts), -1, ends - len(firsts))
    # Near the truth: where lengths go together nowhere, the best fit lies where triangles are flat.
    place = np.where((pose >= 0)[..., None], truth.poses[pose, :2], truth.tags[tag])
    distance_m = np.linalg.norm(place[1] - place[0], axis=-1) + 0.02 * rng.standard_normal(n)
    distances = DistanceFactors(pose[0], tag[0], pose[1], tag[1], np.maximum(distance_m, 0.01), np.full(n, 0.02))
    return replace(problem, measured=Priors(starts, distances))


def _drive(rng: np.random.Generator, lengths: list[int]) -> tuple[FloatArray, IntArray, IntArray]:
    poses: list[FloatArray] = []
    first = []
    for length in lengths:
        poses.append(np.r_[rng.uniform(-2.0, 2.0, 2), rng.uniform(-3.0, 3.0)])
        for _ in range(length - 1):
            first.append(len(poses) - 1)
            poses.append(se2.compose(poses[-1], [rng.uniform(0.1, 0.3), rng.normal(0, 0.02), rng.normal(0, 0.4)]))
    return np.array(poses), np.array(first, dtype=np.int64), np.repeat(np.arange(len(lengths)), lengths)


def _odometry(rng: np.random.Generator, truth: State, first: IntArray, robot_of: IntArray) -> OdometryFactors:
    parameters = (1 + _OF_ROBOT * robot_of[first])[:, None] + np.arange(3)
    return odometry_of(truth, first, parameters, rng, by_wheels=0.2)


def _observations(
    rng: np.random.Generator, truth: State, lengths: list[int], robot_of: IntArray, reach: float
) -> ObservationFactors:
    pose, tag = _who_reads_what(rng, lengths, len(truth.tags), reach)
    n = len(pose)
    polar, mounted = rng.random(n) < 0.5, rng.random(n) < 0.7
    mount = (4 + _OF_ROBOT * robot_of[pose])[:, None] + np.arange(3)
    scale = np.where(rng.random(n) < 0.8, len(truth.calibration) - 2 + tag % 2, 0)
    camera = mount[:, :1] + 3 + np.arange(len(CAMERA_PARAMETERS))

    def spoil(value: FloatArray) -> None:
        value[rng.random(n) < 0.05] += 1.0

    return observations_of(truth, pose, tag, polar, mounted, (mount, scale, camera), spoil, rng)


def _who_reads_what(
    rng: np.random.Generator, lengths: list[int], n_tags: int, reach: float
) -> tuple[IntArray, IntArray]:
    """Pose and tag of each observation: a tag is seen along a part of two segments, from some poses twice."""
    starts = np.concatenate([[0], np.cumsum(lengths)])
    pose, tag = [], []
    for t in range(n_tags):
        for segment, length in enumerate(lengths):
            if t >= 2 and t % len(lengths) != segment and rng.random() < 0.5:
                continue
            n = max(2, int(reach * rng.random() * length))
            first = int(rng.integers(0, max(1, length - n)))
            at = first + rng.integers(0, min(n, length), max(3, n // 3))
            pose.append(starts[segment] + np.minimum(at, length - 1))
            tag.append(np.full(len(at), t))
    return np.concatenate(pose), np.concatenate(tag)


def _columns(rng: np.random.Generator, n_poses: int, n_tags: int, free: BoolArray, held: float) -> Columns:
    """Poses, tags, calibration; all of the first pose is held, of others what chance says."""
    free_poses = rng.random((n_poses, 3)) >= held
    free_poses[0] = False
    free_tags = np.broadcast_to(rng.random((n_tags, 1)) >= held, (n_tags, 2))
    is_free = np.concatenate([free_poses.reshape(-1), free_tags.reshape(-1), free])
    column = np.where(is_free, np.cumsum(is_free) - 1, -1)
    poses, tags, calibration = np.split(column, [3 * n_poses, 3 * n_poses + 2 * n_tags])
    return Columns(poses.reshape(-1, 3), tags.reshape(-1, 2), calibration, int(is_free.sum()))
