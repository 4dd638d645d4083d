"""How accurate any estimate from wheels, gyro and tag corners can be: the Cramer-Rao bound, from the truth.

Independent of the estimate: nothing of `offline`, every derivative of what is not linear a difference quotient. Unknown
are a pose (x, y, theta) wherever a picture shows a tag and at each start, each tag in all six degrees, of a gyro its
scale and its bias (a random walk), and of the calibration whatever has a prior sigma. Measured are the wheels' turns,
the gyro's and the corners' pixels, all in Gaussian noise. The first run's start is the frame. The covariance of an
estimate is at least the inverse of the information J' C^-1 J and of the priors' (the Bayesian bound for what has one:
van Trees, "Detection, Estimation, and Modulation Theory I", 1968, section 2.4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from tests.benchmarks.accuracy.cramer_rao_measured import (
    N_WHEELS,
    CornerJacobians,
    Noise,
    TrueRun,
    TrueTags,
    calibration_information,
    motion_covariance,
    motion_jacobian,
)


@dataclass(frozen=True)
class Bound:
    """Covariances that no unbiased estimate goes below, in the frame of the first run's start."""

    seen: IntArray  # [S] tags that were seen
    tags: FloatArray  # [2S, 2S] m^2 of their (x, y)
    starts: FloatArray  # [R - 1, 2, 2] m^2 of the other runs' starts
    start_vectors_m: FloatArray  # [R - 1, 2] to these starts

    @property
    def tags_m(self) -> float:
        """The bound on the RMSE of the tags, without alignment."""
        return float(np.sqrt(2.0 * np.diag(self.tags).mean()))

    @property
    def start_to_start_m(self) -> float:
        """The least RMSE of the vectors from the first start to the others."""
        return float(np.sqrt(np.trace(self.starts, axis1=1, axis2=2).mean()))

    @property
    def start_distances_m(self) -> FloatArray:
        """[R - 1] least sigmas of the distances to the other starts."""
        along = self.start_vectors_m / np.linalg.norm(self.start_vectors_m, axis=1, keepdims=True)
        return np.asarray(np.sqrt(np.einsum("ri,rij,rj->r", along, self.starts, along)))


@dataclass(frozen=True)
class _Columns:
    """Columns of the unknowns that couple runs; what is known or unseen goes to column n, which is thrown away."""

    tag: IntArray  # [T] the first of six
    batch: IntArray  # [B]
    calibration: IntArray  # [R, 12]
    gyro: list[IntArray]  # of each run, by TrueGyro.sigma
    prior: FloatArray  # [n] information
    seen: IntArray

    @classmethod
    def of(cls, runs: Sequence[TrueRun], tags: TrueTags) -> "_Columns":
        seen = np.unique(np.concatenate([run.tag for run in runs]))
        gyros = [np.zeros(0) if run.gyro is None else run.gyro.sigma for run in runs]
        sigma = np.concatenate([tags.batch_sigma, *(run.sigma for run in runs), *gyros])
        free = sigma > 0.0
        n = 6 * len(seen) + int(free.sum())
        tag, rest = np.full(len(tags.side_m), n), np.full(len(sigma), n)
        tag[seen] = 6 * np.arange(len(seen))
        rest[free] = 6 * len(seen) + np.arange(int(free.sum()))
        batch, calibration, gyro = np.split(
            rest, np.cumsum([len(tags.batch_sigma), sum(len(run.sigma) for run in runs)])
        )
        by_run = np.split(gyro, np.cumsum([len(each) for each in gyros[:-1]]))
        prior = np.concatenate([np.zeros(6 * len(seen)), 1.0 / sigma[free] ** 2])
        return cls(tag, batch, calibration.reshape(len(runs), -1), by_run, prior, seen)

    @property
    def n(self) -> int:
        return len(self.prior)


def cramer_rao(runs: Sequence[TrueRun], tags: TrueTags, noise: Noise) -> Bound:
    """The bound for runs that are joined by the tags they share."""
    origin, heading_rad = runs[0].place[0], runs[0].heading_rad[0]
    runs = [_run_in_frame(run, origin, heading_rad) for run in runs]
    tags = _tags_in_frame(tags, origin, heading_rad)
    columns = _Columns.of(runs, tags)
    segments = [_Segment(run, tags, noise, columns, index) for index, run in enumerate(runs)]
    segments[0].hold_start()
    S = np.diag(columns.prior) + sum(segment.eliminated() for segment in segments)
    scale = 1.0 / np.sqrt(np.diag(S))
    covariance = scale[:, None] * linalg.inv(scale[:, None] * S * scale) * scale
    rows = (6 * np.arange(len(columns.seen))[:, None] + np.arange(2)).ravel()
    starts = [segment.start_covariance(covariance) for segment in segments[1:]]
    vectors = np.array([[run.place[0].real, run.place[0].imag] for run in runs[1:]])
    return Bound(columns.seen, covariance[np.ix_(rows, rows)], np.array(starts).reshape(-1, 2, 2), vectors)


class _Segment:
    """The information of one run: its own poses, block by block, what couples them with the border, and the border's.

    All arrays of the border have one more column, for entries that are not used.
    """

    def __init__(self, run: TrueRun, tags: TrueTags, noise: Noise, columns: _Columns, index: int) -> None:
        n_poses, n = len(run.pose), columns.n
        self.poses = np.zeros((n_poses, 3, 3))
        self.next = np.zeros((n_poses - 1, 3, 3))  # of a pose (rows) and the one after it (columns)
        self.coupling = np.zeros((n_poses, 3, n + 1))
        self.border = np.zeros((n + 1, n + 1))
        self._add_motions(run, noise, np.concatenate([columns.calibration[index, :N_WHEELS], columns.gyro[index]]))
        corners = CornerJacobians(run, tags)
        n_seen = np.bincount(run.picture, minlength=len(run.picture_pose))
        for count in np.unique(n_seen[n_seen > 0]):
            pictures = np.flatnonzero(n_seen == count)
            seen = np.searchsorted(run.picture, pictures)[:, None] + np.arange(count)
            self._add_pictures(run, tags, noise, columns, index, corners, pictures, seen)

    def _add_motions(self, run: TrueRun, noise: Noise, calibration_columns: IntArray) -> None:
        """Of wheels and gyro, where there is one."""
        J, C = motion_jacobian(run, noise), motion_covariance(run, noise)
        weighted = np.linalg.inv(C) @ J
        information = J[..., :6].swapaxes(-1, -2) @ weighted  # first pose 3, second pose 3; then the calibration too
        self.poses[:-1] += information[:, :3, :3]
        self.poses[1:] += information[:, 3:6, 3:6]
        self.next += information[:, :3, 3:6]
        for at, rows in ((slice(None, -1), slice(0, 3)), (slice(1, None), slice(3, 6))):
            for k, column in enumerate(calibration_columns):
                self.coupling[at, :, column] += information[:, rows, 6 + k]
        by_motions = np.tensordot(J[..., 6:], weighted[..., 6:], axes=((0, 1), (0, 1)))
        self.border[np.ix_(calibration_columns, calibration_columns)] += by_motions + calibration_information(
            run, noise
        )

    def _add_pictures(
        self, run: TrueRun, tags: TrueTags, noise: Noise, columns: _Columns, index: int, corners: "CornerJacobians",
        pictures: IntArray, seen: IntArray,
    ) -> None:  # fmt: skip
        """Pictures [G] that show as many tags each: tracks `seen` [G, m]."""
        n_pictures, m = seen.shape
        common = columns.calibration[index, N_WHEELS:]
        J = np.zeros((n_pictures, 8 * m, 3 + 7 * m + len(common)))
        J[..., :3] = corners.by_pose[seen].reshape(n_pictures, 8 * m, 3)
        J[..., 3 + 7 * m :] = corners.by_camera[seen].reshape(n_pictures, 8 * m, -1)
        where = np.empty((n_pictures, 7 * m + len(common)), dtype=np.int64)
        where[:, 7 * m :] = common
        for k in range(m):
            tag = run.tag[seen[:, k]]
            J[:, 8 * k : 8 * k + 8, 3 + 7 * k : 10 + 7 * k] = corners.by_tag[seen[:, k]]
            where[:, 7 * k : 7 * k + 6] = np.minimum(columns.tag[tag][:, None] + np.arange(6), columns.n)
            where[:, 7 * k + 6] = columns.batch[tags.batch[tag]]
        sway = corners.by_sway[seen].reshape(n_pictures, 8 * m, 3) * [noise.tilt_rad, noise.tilt_rad, noise.height_m]
        C = noise.corner_px**2 * np.eye(8 * m) + sway @ sway.swapaxes(-1, -2)
        whitened = np.linalg.solve(np.linalg.cholesky(C), J)
        information = whitened.swapaxes(-1, -2) @ whitened
        pose = run.picture_pose[pictures]
        np.add.at(self.poses, pose, information[:, :3, :3])
        axes = np.arange(3)[None, :, None]
        np.add.at(self.coupling, (pose[:, None, None], axes, where[:, None, :]), information[:, :3, 3:])
        np.add.at(self.border, (where[:, :, None], where[:, None, :]), information[:, 3:, 3:])

    def hold_start(self) -> None:
        """Takes the first pose for known."""
        self.poses[0], self.next[:1], self.coupling[0] = np.eye(3), 0.0, 0.0

    def eliminated(self) -> FloatArray:
        """[n, n] information of the run about the border, with its poses marginalised."""
        n_poses = len(self.poses)
        banded = np.zeros((6, 3 * n_poses))  # LAPACK's lower form: row d holds the d-th diagonal below the main one
        for i in range(3):
            for j in range(3):
                if i >= j:
                    banded[i - j, j::3] = self.poses[:, i, j]
                banded[3 + i - j, j : 3 * (n_poses - 1) : 3] = self.next[:, j, i]
        own = self.coupling[..., :-1].reshape(3 * n_poses, -1)
        start = np.eye(3 * n_poses, 2)
        solved = linalg.solveh_banded(banded, np.column_stack([own, start]), lower=True)
        self._start_own, self._start_by_border = solved[:2, -2:], solved[:2, :-2]
        return np.asarray(self.border[:-1, :-1] - own.T @ solved[:, :-2])

    def start_covariance(self, border_covariance: FloatArray) -> FloatArray:
        """[2, 2] of the start's (x, y), given that of the border."""
        return np.asarray(self._start_own + self._start_by_border @ border_covariance @ self._start_by_border.T)


def _run_in_frame(run: TrueRun, origin: complex, heading_rad: float) -> TrueRun:
    place = (run.place - origin) * np.exp(-1j * heading_rad)
    return replace(run, place=place, heading_rad=run.heading_rad - heading_rad)


def _tags_in_frame(tags: TrueTags, origin: complex, heading_rad: float) -> TrueTags:
    turn = Rotation.from_euler("z", -heading_rad).as_matrix()
    place = (tags.place_m - [origin.real, origin.imag, 0.0]) @ turn.T
    return replace(tags, place_m=place, rotation=turn @ tags.rotation)
