"""What maps are compared with: the wheels alone, and the scheme of the paper as it was.

Both take keyframes and tag observations as `groundsbot.offline.measurements.segment` has them, so that only what is
made of them differs, and lay runs over each other by the tags that they share. Neither has consistent
covariances, so none are given.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Final

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.maps.result import Component, MapResult, RunResult, TagResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import TagKey

# The paper's solver: odometry's x, y, then heading; a tag observation's x and y.
ODOMETRY_VARIANCE: Final = (2.5e-5, 2.5e-5, 2.5e-6)
OBSERVATION_VARIANCE: Final = 25.0
EVERY: Final = 5
_ROUNDS: Final = 20
_ARRIVED: Final = 1e-4  # m and rad


@dataclass(frozen=True)
class _Drive:
    """One run: K poses along it, and what was read of tags in base from which."""

    run: Run
    stamps_ns: IntArray  # (K,)
    motion: FloatArray  # (K - 1, 3) from pose to pose
    poses: FloatArray  # (K, 3) in the frame of its start
    at: IntArray  # (M,) pose of each observation
    tags: tuple[TagKey, ...]
    tag: IntArray  # (M,) index into tags
    place_m: FloatArray  # (M, 2) in base

    def tag_places(self) -> dict[TagKey, FloatArray]:
        """The mean of what was read of each tag, in the frame of the start."""
        read = se2.apply(self.poses[self.at], self.place_m)
        return {tag: read[self.tag == index].mean(axis=0) for index, tag in enumerate(self.tags)}


def dead_reckoning(runs: Sequence[Run]) -> MapResult:
    """Trajectories by the wheels alone; each tag at the mean of its observations, the first run's counting like any."""
    drives = [_keyframes(run) for run in runs]
    transforms, places = _lay_out([drive.tag_places() for drive in drives])
    return _as_map(drives, [se2.compose(T, each.poses) for T, each in zip(transforms, drives, strict=True)], places)


def paper_scheme(runs: Sequence[Run]) -> MapResult:
    """The paper's: every fifth wheel reading, Euler steps, local maps, RANSAC, one solve, its fixed variances."""
    drives = [_states(run) for run in runs]
    alone = [_least_squares([drive], [drive.poses], drive.tag_places(), None) for drive in drives]
    transforms, places = _lay_out([of_tags for _, of_tags in alone])
    start = [se2.compose(T, poses[0]) for T, (poses, _) in zip(transforms, alone, strict=True)]
    return _as_map(drives, *_least_squares(drives, start, places, transforms))


def _segment(run: Run) -> Segment:
    (segment,) = segments_of(run, NoiseParameters())
    return segment


def _keyframes(run: Run) -> _Drive:
    segment = _segment(run)
    observations, odometry = segment.observations, segment.odometry
    return _Drive(
        run, segment.stamps_ns, odometry.motion, odometry.dead_reckon(), observations.keyframe, segment.tags,
        observations.tag, _places_in_base(segment),
    )  # fmt: skip


def _states(run: Run) -> _Drive:
    """Poses at every fifth wheel reading, whose speeds count until the next one. Observations belong to the last."""
    segment, (wheel_segment,) = _segment(run), run.wheel_segments
    stamps_ns = wheel_segment.stamps_ns[::EVERY]
    seconds = np.diff(wheel_segment.stamps_ns) * 1e-9
    left_m_s, right_m_s = (
        np.diff(each, prepend=each[0])[::EVERY] for each in (wheel_segment.left_m, wheel_segment.right_m)
    )
    seconds = np.concatenate([[1.0], seconds])[::EVERY]
    step_s = np.diff(stamps_ns) * 1e-9
    left_m, right_m = (each[:-1] / seconds[:-1] * step_s for each in (left_m_s, right_m_s))
    turn_rad = (right_m - left_m) / run.robot.wheels.track_m
    motion = np.stack([0.5 * (left_m + right_m), np.zeros(len(left_m)), turn_rad], axis=-1)
    heading = np.concatenate([[0.0], np.cumsum(motion[:, 2])])
    steps = motion[:, :1] * np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=-1)
    poses = np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading])
    at = np.searchsorted(stamps_ns, segment.stamps_ns[segment.observations.keyframe], side="right") - 1
    return _Drive(run, stamps_ns, motion, poses, at, segment.tags, segment.observations.tag, _places_in_base(segment))


def _places_in_base(segment: Segment) -> FloatArray:
    observations = segment.observations
    range_m, bearing = observations.value.T
    return se2.apply(segment.T_base_sensor, np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=-1))


def _lay_out(maps: Sequence[dict[TagKey, FloatArray]]) -> tuple[list[FloatArray], dict[TagKey, FloatArray]]:
    """Places maps in the first one's frame, those that share most tags with what is there first.

    Returns:
        For each the transform (3,) into that frame, and each tag at the mean of where they have it.

    Raises:
        ValueError: one shares fewer than two tags with all others.
    """
    placed = {0: np.zeros(3)}
    while True:
        moved: dict[TagKey, list[FloatArray]] = {}
        for index, T in placed.items():
            for tag, place in maps[index].items():
                moved.setdefault(tag, []).append(se2.apply(T, place))
        places = {tag: np.mean(each, axis=0) for tag, each in moved.items()}
        if len(placed) == len(maps):
            return [placed[index] for index in range(len(maps))], places
        waiting = [index for index in range(len(maps)) if index not in placed]
        best = max(waiting, key=lambda index: len(set(maps[index]) & set(places)))
        placed[best] = _lay_over(maps[best], places)


def _lay_over(places: dict[TagKey, FloatArray], onto: dict[TagKey, FloatArray]) -> FloatArray:
    """(3,) of the transforms by two shared tags that which leaves the least distance between all of them.

    This is the paper's RANSAC with every pair drawn.
    """
    shared = sorted(set(places) & set(onto))
    if len(shared) < 2:
        raise ValueError(f"{len(shared)} tags are shared with other runs; two are needed")
    own, others = (np.array([each[tag] for tag in shared]) @ [1.0, 1.0j] for each in (places, onto))
    best, least = np.zeros(3), np.inf
    for a, b in combinations(range(len(shared)), 2):
        turn = np.exp(1j * np.angle((others[b] - others[a]) / (own[b] - own[a])))
        move = 0.5 * (others[a] + others[b] - turn * (own[a] + own[b]))
        apart = float(np.abs(turn * own + move - others).sum())
        if apart < least:
            best, least = np.array([move.real, move.imag, np.angle(turn)]), apart
    return best


def _least_squares(
    drives: Sequence[_Drive], poses: Sequence[FloatArray], places: dict[TagKey, FloatArray],
    transforms: Sequence[FloatArray] | None,
) -> tuple[list[FloatArray], dict[TagKey, FloatArray]]:  # fmt: skip
    """Gauss-Newton as the paper has it: odometry in the world frame, its Jacobian blind to the heading.

    The first drive's start is held. `transforms` are the priors on the others' starts, with odometry's variances.
    """
    names = list(places)
    first = np.concatenate([[0], np.cumsum([3 * len(each) for each in poses])])
    x = np.concatenate([np.concatenate(list(poses)).ravel(), np.concatenate([places[name] for name in names])])
    for _ in range(_ROUNDS):
        J, r = _linearise(drives, x, first, names, transforms)
        step = splu((J.T @ J).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(J.T @ r)
        x = x - step
        if np.abs(step).max() < _ARRIVED:
            break
    parts = [x[begin:end].reshape(-1, 3) for begin, end in pairwise(first)]
    return parts, dict(zip(names, x[first[-1] :].reshape(-1, 2), strict=True))


def _linearise(
    drives: Sequence[_Drive], x: FloatArray, first: IntArray, names: Sequence[TagKey],
    transforms: Sequence[FloatArray] | None,
) -> tuple[sparse.csr_array, FloatArray]:  # fmt: skip
    weights = 1.0 / np.sqrt(ODOMETRY_VARIANCE)
    rows, columns, values, residuals, n_rows = [], [], [], [], 0

    def add(block: FloatArray, at: IntArray, residual: FloatArray) -> None:
        """M residuals (M, k) and their derivatives (M, k, c) by the unknowns `at` (M, c)."""
        nonlocal n_rows
        m, k, _ = block.shape
        rows.append(np.broadcast_to((n_rows + np.arange(m * k)).reshape(m, k, 1), block.shape).ravel())
        columns.append(np.broadcast_to(at[:, None], block.shape).ravel())
        values.append(block.ravel())
        residuals.append(residual.ravel())
        n_rows += m * k

    for index, drive in enumerate(drives):
        own = first[index] + np.arange(3 * len(drive.poses)).reshape(-1, 3)
        poses = x[own]
        theta = poses[:, 2]
        ahead = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        told = np.column_stack([drive.motion[:, :1] * ahead[:-1], drive.motion[:, 2]])
        block = np.concatenate([-np.diag(weights), np.diag(weights)], axis=1)
        add(
            np.tile(block, (len(told), 1, 1)), np.hstack([own[:-1], own[1:]]),
            _wrap(np.diff(poses, axis=0) - told) * weights,
        )  # fmt: skip
        held = np.zeros(3) if transforms is None else transforms[index]
        weight = weights if index else np.full(3, 1e6)
        add(np.diag(weight)[None], own[:1], _wrap(poses[:1] - held) * weight)
        at_tag = first[-1] + 2 * np.array([names.index(tag) for tag in drive.tags])[drive.tag]
        place, (cos, sin) = x[at_tag[:, None] + [0, 1]], ahead[drive.at].T
        dx, dy = (place - poses[drive.at, :2]).T
        seen = np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)
        by = np.zeros((len(dx), 2, 5))
        by[:, 0] = np.stack([-cos, -sin, seen[:, 1], cos, sin], axis=-1)
        by[:, 1] = np.stack([sin, -cos, -seen[:, 0], -sin, cos], axis=-1)
        weight = OBSERVATION_VARIANCE**-0.5
        add(by * weight, np.hstack([own[drive.at], at_tag[:, None] + [0, 1]]), (seen - drive.place_m) * weight)
    J = sparse.coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (n_rows, len(x)))
    return J.tocsr(), np.concatenate(residuals)


def _wrap(differences: FloatArray) -> FloatArray:
    return np.column_stack([differences[:, :2], se2.wrap_angle(differences[:, 2])])


def _as_map(drives: Sequence[_Drive], poses: Sequence[FloatArray], places: dict[TagKey, FloatArray]) -> MapResult:
    """In the frame of the first run's start; covariances unknown."""
    runs = tuple(
        RunResult(
            drive.run.name, drive.run.name, Path(drive.run.log), drive.run.robot_id, drive.run.run_id, each[0],
            np.full((3, 3), np.nan), drive.stamps_ns, each, float(np.abs(drive.motion[:, 0]).sum()),
        )
        for drive, each in zip(drives, poses, strict=True)
    )  # fmt: skip
    tags = tuple(
        TagResult(
            tag.family, tag.tag_id, tag.instance, None, place, np.full((2, 2), np.nan),
            sum(int((drive.tag == drive.tags.index(tag)).sum()) for drive in drives if tag in drive.tags),
            tuple(drive.run.name for drive in drives if tag in drive.tags),
        )
        for tag, place in places.items()
    )  # fmt: skip
    n = 3 * len(runs) + 2 * len(tags)
    component = Component(runs[0].name, runs, tags, np.full((n, n), np.nan), 0.0, 0)
    return MapResult((component,), (), NoiseParameters())
