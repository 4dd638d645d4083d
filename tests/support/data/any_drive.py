"""Drives of mecanum, swerve and Ackermann robots as CSV folders, with their truth."""

from dataclasses import dataclass
from math import atan, pi
from pathlib import Path
from typing import Final, Literal

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.geometry.se2 import chain_motions
from groundsbot.calib.robot.noise import NoiseParameters

Drive = Literal["mecanum", "swerve", "ackermann"]
DRIVES: Final[tuple[Drive, ...]] = ("mecanum", "swerve", "ackermann")
WHEELBASE_M: Final = 0.9
CAMERA_X_M: Final = 0.2
_RATE_HZ: Final = 20.0
_BEGINS_S: Final = 10.0  # a header stamp of 0 in a bag means none
_HALF_FIELD_M: Final = (8.0, 4.0)
_SPEED_M_S: Final = 1.0
_FARTHEST_M: Final = 6.0
_HALF_VIEW_RAD: Final = 0.6
_MOST_STEERING_RAD: Final = 0.5
_N_TAGS: Final = 24


@dataclass(frozen=True)
class MadeDrive:
    """What a robot counted and saw.

    Attributes:
        time_s: (N,).
        speeds: (N, 3) m/s forward, m/s to the left, rad/s, each the mean since the row before.
        T_world_base: (N, 3) where it was.
        tags_m: (T, 2).
        seen: rows of time, tag, range and bearing about the camera.
    """

    time_s: FloatArray
    speeds: FloatArray
    T_world_base: FloatArray
    tags_m: FloatArray
    seen: FloatArray


def make_any_drive(kind: Drive, seed: int, seconds: float) -> MadeDrive:
    """A robot from one random place of a field to the next, with noise as `NoiseParameters` has it.

    A swerve robot turns as it likes while it drives, a mecanum robot slowly and slips three times as much across its
    way, a steered one goes where it looks.
    """
    rng = np.random.default_rng(seed)
    noise = NoiseParameters()
    n, dt_s = round(seconds * _RATE_HZ), 1.0 / _RATE_HZ
    pose, goal = np.zeros(3), rng.uniform(-1.0, 1.0, 2) * _HALF_FIELD_M
    speeds, poses = np.zeros((n, 3)), np.zeros((n, 3))
    spin_rad_s = 0.0
    for i in range(1, n):
        while np.hypot(*(goal - pose[:2])) < 1.0:
            goal = rng.uniform(-1.0, 1.0, 2) * _HALF_FIELD_M
            spin_rad_s = rng.uniform(-1.0, 1.0) * (1.0 if kind == "swerve" else 0.3)
        to_goal = se2.apply(se2.inverse(pose), goal)
        speeds[i] = _velocity(kind, to_goal, spin_rad_s)
        step = speeds[i] * dt_s
        way_m = float(np.hypot(*step[:2]))
        along = step[:2] / max(way_m, 1e-9)
        across_times = 3.0 if kind == "mecanum" else 1.0
        drawn = rng.standard_normal(3) * [
            noise.sigma_distance_m_per_sqrt_m * way_m**0.5,
            across_times * noise.sigma_lateral_m_per_sqrt_m * way_m**0.5,
            np.hypot(
                noise.sigma_heading_rad_per_sqrt_m * way_m**0.5,
                noise.sigma_heading_rad_per_sqrt_rad * abs(step[2]) ** 0.5,
            ),
        ]
        error = np.r_[drawn[0] * along + drawn[1] * np.array([-along[1], along[0]]), drawn[2]]
        pose = se2.compose(se2.compose(pose, se2.exp(step)), se2.exp(error))
        poses[i] = pose
    tags_m = rng.uniform(-1.2, 1.2, (_N_TAGS, 2)) * _HALF_FIELD_M
    time_s: FloatArray = _BEGINS_S + dt_s * np.arange(n, dtype=np.float64)
    return MadeDrive(time_s, speeds, poses, tags_m, _tracks(time_s, poses, tags_m, noise, rng))


def _velocity(kind: Drive, to_goal: FloatArray, spin_rad_s: float) -> FloatArray:
    direction = to_goal / np.hypot(*to_goal)
    if kind != "ackermann":
        return np.append(_SPEED_M_S * direction, spin_rad_s)
    # Straight at the goal as far as the wheels turn.
    steering = np.clip(np.arctan2(direction[1], direction[0]), -_MOST_STEERING_RAD, _MOST_STEERING_RAD)
    return np.array([_SPEED_M_S, 0.0, _SPEED_M_S * np.tan(steering) / WHEELBASE_M])


def _tracks(
    time_s: FloatArray, poses: FloatArray, tags_m: FloatArray, noise: NoiseParameters, rng: np.random.Generator
) -> FloatArray:
    rows = []
    for at in range(4, len(poses), 4):
        T_world_camera = se2.compose(poses[at], [CAMERA_X_M, 0.0, 0.0])
        x, y = se2.apply(se2.inverse(T_world_camera), tags_m).T
        range_m, bearing_rad = np.hypot(x, y), np.arctan2(y, x)
        for tag in np.flatnonzero((range_m < _FARTHEST_M) & (range_m > 0.5) & (np.abs(bearing_rad) < _HALF_VIEW_RAD)):
            sigma_m = np.hypot(noise.sigma_range_m, noise.sigma_range_per_m * range_m[tag])
            read = range_m[tag] + sigma_m * rng.standard_normal()
            rows.append([time_s[at], tag, read, bearing_rad[tag] + noise.sigma_bearing_rad * rng.standard_normal()])
    return np.array(rows)


def write_csv(folder: Path, drive: MadeDrive, form: Literal["velocities", "poses", "steering"]) -> Path:
    """The drive as a folder that `import` reads; returns the folder."""
    folder.mkdir(parents=True)
    if form == "poses":
        dt_s = np.diff(drive.time_s)[:, None]
        odometry = chain_motions(se2.exp(drive.speeds[1:] * dt_s), np.array([2.0, -1.0, 0.5 * pi]))
        head = "t_s,x_m,y_m,theta_rad"
    elif form == "steering":
        steering = [atan(w * WHEELBASE_M / max(v, 1e-9)) for v, _, w in drive.speeds.tolist()]
        odometry, head = np.column_stack([drive.speeds[:, 0], steering]), "t_s,v_m_s,steering_rad"
    else:
        odometry, head = drive.speeds, "t_s,vx_m_s,vy_m_s,omega_rad_s"
    rows = [",".join(map(repr, row)) for row in np.column_stack([drive.time_s, odometry]).tolist()]
    (folder / "odometry.csv").write_text("\n".join([head, *rows]) + "\n")
    seen = [f"{t!r},{int(tag)},{r!r},{b!r}" for t, tag, r, b in drive.seen.tolist()]
    (folder / "observations.csv").write_text("\n".join(["t_s,tag_id,range_m,bearing_rad", *seen]) + "\n")
    return folder
