"""Small problems of tag corners at random, and their residuals by the definition."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS
from groundsbot.offline.corners.factors import (
    CornerFactors,
    SpatialColumns,
    SpatialState,
    columns_of,
)
from groundsbot.offline.corners.kernels.view import CornerObservations
from groundsbot.offline.corners.problem import CornerProblem
from groundsbot.offline.measurements.sensor_model.tag_pose import UNIT_CORNERS
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    ObservationFactors,
    OdometryFactors,
)
from groundsbot.offline.sam.factors.priors import NO_PRIORS

CAMERAS = {
    "plumb_bob": (-0.18, 0.07, 0.0006, -0.0004, 0.01),
    "rational_polynomial": (0.3, -0.1, 0.0005, -0.0003, 0.02, 0.5, -0.05, 0.01),
    "equidistant": (-0.01, 0.004, -0.002, 0.0003),
}
N_POSES, N_TAGS, N_LOOKS = 5, 3, 12
SIGMAS = np.array([0.0, 0.01, 0.01, 0.01, 0.02, 0.02, 0.02, 0.01, 0.01, 0.01, 0.1])
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a level camera's axes in base
WALL = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # faces a viewer who looks along x


def make_state(rng: np.random.Generator) -> SpatialState:
    """Poses near the origin that look along x, at tilted tags two to four metres away."""
    turns = Rotation.from_rotvec(0.3 * rng.standard_normal((N_TAGS, 3))).as_matrix() @ WALL
    return SpatialState(
        poses=np.column_stack([0.2 * rng.standard_normal((N_POSES, 2)), 0.1 * rng.standard_normal(N_POSES)]),
        tags=np.column_stack([rng.uniform(2, 4, N_TAGS), rng.uniform(-0.6, 0.6, N_TAGS)]),
        calibration=np.r_[0.0, 0.01 * rng.standard_normal(len(SIGMAS) - 1)],
        heights_m=rng.uniform(0.3, 0.6, N_TAGS),
        turns=turns,
    )


def make_factors(rng: np.random.Generator, model: str = "plumb_bob") -> CornerFactors:
    """Looks by two cameras at once, each row read out from elsewhere."""
    camera = CameraModel("one", 1280, 720, 902.4, 901.1, 643.2, 356.7, model, CAMERAS[model])
    looks = CornerObservations(
        pose=np.sort(np.concatenate([np.arange(N_POSES), rng.integers(0, N_POSES, N_LOOKS - N_POSES)])),
        tag=np.arange(N_LOOKS) % N_TAGS,
        corners_px=rng.uniform(0, 700, (N_LOOKS, 4, 2)),
        sigma_px=rng.uniform(0.5, 2.0, N_LOOKS),
        side_m=np.full(N_LOOKS, 0.15),
        camera=np.arange(N_LOOKS) % 2,
        moved=0.02 * rng.standard_normal((N_LOOKS, 4, 3)),
        twist=0.5 * rng.standard_normal((N_LOOKS, 3)),
        mount=np.tile([0.15, 0.02, 0.42, 0.02, 0.03, 0.1], (N_LOOKS, 1)),
        mount_parameters=np.tile(np.arange(1, 7), (N_LOOKS, 1)),
        time_parameter=np.full(N_LOOKS, 7),
        scale_parameter=np.full(N_LOOKS, 8),
        focal_parameter=np.full(N_LOOKS, 9),
        edge_parameter=np.full(N_LOOKS, 10),
        outward=rng.uniform(-2.0, 2.0, (N_LOOKS, 4, 2)),
        jitter=np.zeros((N_LOOKS, 8)),
    )
    return CornerFactors(looks, (camera, replace(camera, fx_px=700.0)))


def plain_residual(factors: CornerFactors, state: SpatialState) -> FloatArray:
    """Return the whitened residuals (M, 8) by the definition, with scipy's rotations and calib's projection."""
    looks = factors.observations
    side_m = looks.side_m * (1.0 + state.calibration[looks.scale_parameter])
    in_tag = np.pad(UNIT_CORNERS, ((0, 0), (0, 1))) * side_m[:, None, None]
    centre = np.column_stack([state.tags, state.heights_m])
    in_map = in_tag @ state.turns[looks.tag].swapaxes(-1, -2) + centre[looks.tag][:, None]
    late_s = state.calibration[looks.time_parameter][:, None]
    T_keyframe_base = se2.compose(looks.moved, se2.exp(-late_s * looks.twist)[:, None])
    T_map_base = se2.compose(state.poses[looks.pose][:, None], T_keyframe_base)
    in_base = np.concatenate([se2.apply(se2.inverse(T_map_base), in_map[..., :2]), in_map[..., 2:]], axis=-1)
    mount = looks.mount + state.calibration[looks.mount_parameters]
    R_base_camera = Rotation.from_euler("ZYX", mount[:, [5, 4, 3]]).as_matrix() @ OPTICAL
    in_camera = (in_base - mount[:, None, :3]) @ R_base_camera
    pixels = np.stack([factors.cameras[i].project(points) for i, points in zip(looks.camera, in_camera, strict=True)])
    principal = np.array([[each.cx_px, each.cy_px] for each in factors.cameras])[looks.camera][:, None]
    focal, shift = (state.calibration[each][:, None, None] for each in (looks.focal_parameter, looks.edge_parameter))
    predicted_px = principal + (1.0 + focal) * (pixels - principal) + shift * looks.outward
    return np.asarray((predicted_px - looks.corners_px) / looks.sigma_px[:, None, None]).reshape(-1, 8)


def make_problem(
    seed: int, attitude_sigma_rad: tuple[float, float, float] = (0.0, 0.0, 0.0), model: str = "plumb_bob"
) -> tuple[CornerProblem, SpatialState]:
    """Looks that fit the state but for some pixels, and the motions between its poses."""
    rng = np.random.default_rng(seed)
    state, factors = make_state(rng), make_factors(rng, model)
    state = replace(state, poses=np.concatenate([np.zeros((1, 3)), state.poses[1:]]))
    seen = (
        factors.observations.corners_px
        + plain_residual(factors, state).reshape(-1, 4, 2) * factors.observations.sigma_px[:, None, None]
    )
    noisy = seen + 0.5 * rng.standard_normal(seen.shape)
    none = np.zeros(0, dtype=np.int64)
    steps = np.arange(N_POSES - 1)
    problem = CornerProblem(
        odometry=OdometryFactors(
            steps,
            se2.between(state.poses[:-1], state.poses[1:]),
            np.tile(np.eye(3) / 0.05, (N_POSES - 1, 1, 1)),
            np.zeros((N_POSES - 1, 3, 3)),
            np.zeros((N_POSES - 1, 3), dtype=np.int64),
        ),
        corners=replace(factors, observations=factors.observations._replace(corners_px=noisy)),
        observations=ObservationFactors(
            none,
            none,
            np.zeros((0, 2)),
            none > 0,
            np.zeros((0, 2, 2)),
            np.zeros((0, 3)),
            np.zeros((0, 3), dtype=int),
            none,
            np.zeros((0, 2, len(CAMERA_PARAMETERS))),
            np.zeros((0, len(CAMERA_PARAMETERS)), dtype=int),
            np.zeros(0),
        ),
        prior=CalibrationPrior(SIGMAS),
        measured=NO_PRIORS,
        columns=columns_of(N_POSES, np.ones(N_TAGS, dtype=bool), SIGMAS),
        anchor=np.arange(N_TAGS),
        attitude_sigmas=np.array(attitude_sigma_rad),
    )
    return problem, state


def perturb(state: SpatialState, columns: SpatialColumns, step: FloatArray) -> SpatialState:
    """The plainest observation of what columns mean."""
    padded = np.append(step, 0.0)
    return SpatialState(
        se2.compose(state.poses, se2.exp(padded[columns.poses])),
        state.tags + padded[columns.tags],
        state.calibration + padded[columns.calibration],
        state.heights_m + padded[columns.heights],
        state.turns @ Rotation.from_rotvec(padded[columns.turns]).as_matrix(),
    )


def dense(columns: SpatialColumns, own: IntArray, values: FloatArray) -> FloatArray:
    """Rows of all columns from blocks (M, r, k) and the columns (M, k) they belong to."""
    out = np.zeros((*values.shape[:2], columns.n + 1))
    for m, each in enumerate(own):
        for k, column in enumerate(each):
            out[m, :, column] += values[m, :, k]
    rows: FloatArray = out[..., :-1]
    return rows
