"""Small estimation problems with every kind of factor, whose truth is known."""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    State,
)
from groundsbot.offline.sam.solver import Problem
from tests.support.data.factors import observations_of, odometry_of

# Calibration: a held zero, three wheel parameters, three of the mount, two batches of tags, more of the camera.
CALIBRATION_SIGMA = np.array(
    [0.0, 0.004, 0.007, 0.01, 0.01, 0.01, 0.01, 0.005, 0.005, *(0.01,) * len(CAMERA_PARAMETERS)]
)
N_CALIBRATION = len(CALIBRATION_SIGMA)
WHEELS, MOUNT, BATCHES, CAMERA = np.array([1, 2, 3]), np.array([4, 5, 6]), np.array([7, 8]), np.arange(9, N_CALIBRATION)
SEGMENTS = (9, 7)  # poses in each
N_TAGS = 6


@dataclass(frozen=True)
class MadeProblem:
    """A problem and the state its measurements are of."""

    problem: Problem
    truth: State


def make_problem(seed: int, noise: float = 1.0, n_outliers: int = 0, *, true_calibration: bool = False) -> MadeProblem:
    """Two segments past six tags; observations polar and cartesian, about a mounted camera and about base.

    Args:
        seed: of everything.
        noise: measurements are off by this many of their sigmas.
        n_outliers: observations that are metres off.
        true_calibration: robots and tags are what their files say.
    """
    rng = np.random.default_rng(seed)
    n_poses = sum(SEGMENTS)
    poses = [np.zeros(3)]
    first = []
    for segment, length in enumerate(SEGMENTS):
        if segment:
            poses.append(np.array([2.0, -1.0, 2.5]))
        for _ in range(length - 1):
            first.append(len(poses) - 1)
            poses.append(se2.compose(poses[-1], [rng.uniform(0.2, 0.6), rng.normal(0, 0.02), rng.normal(0, 0.4)]))
    calibration = CALIBRATION_SIGMA * (0.0 if true_calibration else _draw(rng))
    truth = State(np.array(poses), rng.uniform(-4, 4, (N_TAGS, 2)), calibration)
    problem = Problem(
        odometry=odometry_of(truth, np.array(first), np.tile(WHEELS, (len(first), 1)), rng, by_wheels=0.4, noise=noise),
        observations=_observations(truth, noise, n_outliers, rng),
        prior=CalibrationPrior(CALIBRATION_SIGMA),
        columns=make_columns(n_poses),
        anchor=rng.integers(0, n_poses, N_TAGS),
    )
    return MadeProblem(problem, truth)


def make_columns(n_poses: int) -> Columns:
    """Poses, tags, calibration; the first pose and the first calibration number are held."""
    poses = np.arange(-3, 3 * n_poses - 3).reshape(n_poses, 3)
    poses[0] = -1
    n = 3 * n_poses - 3
    tags = n + np.arange(2 * N_TAGS).reshape(N_TAGS, 2)
    calibration = np.r_[-1, n + 2 * N_TAGS + np.arange(N_CALIBRATION - 1)]
    return Columns(poses, tags, calibration, n + 2 * N_TAGS + N_CALIBRATION - 1)


def random_state(seed: int, near: State | None = None, spread: float = 0.0) -> State:
    """A state near another one, or just anywhere: headings round the circle, calibration of several percent."""
    rng = np.random.default_rng(seed)
    n_poses = sum(SEGMENTS)
    if near is None:
        poses = np.column_stack([rng.uniform(-5, 5, (n_poses, 2)), rng.uniform(-np.pi, np.pi, n_poses)])
        return State(poses, rng.uniform(-5, 5, (N_TAGS, 2)), np.r_[0.0, 0.05 * rng.standard_normal(N_CALIBRATION - 1)])
    poses = se2.compose(near.poses, se2.exp(spread * rng.standard_normal((n_poses, 3))))
    poses[0] = near.poses[0]
    tags = near.tags + spread * rng.standard_normal((N_TAGS, 2))
    return State(poses, tags, np.r_[0.0, 0.1 * spread * rng.standard_normal(N_CALIBRATION - 1)])


def _draw(rng: np.random.Generator) -> FloatArray:
    """Calibration in sigmas; all but twelve numbers by a generator of their own."""
    others, more = rng.standard_normal(12), rng.spawn(1)[0].standard_normal(N_CALIBRATION - 12)
    return np.concatenate([others, more])


def _observations(truth: State, noise: float, n_outliers: int, rng: np.random.Generator) -> ObservationFactors:
    pose, tag = (index.reshape(-1) for index in np.mgrid[0 : len(truth.poses), 0:N_TAGS])
    n = len(pose)
    polar, mounted = rng.random(n) < 0.5, rng.random(n) < 0.5
    scale_parameter = np.where(rng.random(n) < 0.8, BATCHES[tag % 2], 0)

    def spoil(value: FloatArray) -> None:
        value[rng.choice(n, n_outliers, replace=False)] += 3.0

    parameters = np.tile(MOUNT, (n, 1)), scale_parameter, np.tile(CAMERA, (n, 1))
    return observations_of(truth, pose, tag, polar, mounted, parameters, spoil, rng, noise)
