"""What the factors tie down, and what could still move without any of them noticing: from who reads which tag.

Odometry makes each segment one rigid body; a tag is a pin that each segment which reads it holds at a place of its own.
A segment that shares no tag can move in three ways, one that shares a single tag can turn about it, and so on. The rank
follows from these few bodies, so it does not suffer from the rounding of a long segment's normal equations. A tag at
the end of a measured distance is a body of its own, a point.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import linalg, sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, ObservationFactors, OdometryFactors, State
from groundsbot.offline.sam.factors.priors import DistanceFactors, Priors, StartFactors, ends_of

# Motions whose square is resisted this much less than the best resisted one; rounding stays a thousand times below.
_FREE: Final = 1e-12
_MOVES: Final = 1e-6


@dataclass(frozen=True)
class UnobservableDirections:
    """What nothing ties down.

    Attributes:
        n_directions: dimensions in which the variables can move at no cost.
        segments: those that can move against what is held; a segment is a row of poses that odometry joins, numbered in
            the order of poses.
        tags: those without any observation.
    """

    n_directions: int
    segments: tuple[int, ...]
    tags: tuple[int, ...]


def find_unobservable(
    odometry: OdometryFactors, observations: ObservationFactors, measured: Priors, columns: Columns, state: State
) -> UnobservableDirections:
    """Looks for motions of whole segments, and for tags, that change no residual; priors hold all calibration.

    Args:
        odometry: each of full rank.
        observations: each of full rank in its tag.
        measured: each of full rank.
        columns: what is held.
        state: where segments and tags lie.
    """
    segment_of = segments_of_poses(odometry, len(columns.poses))
    n_segments = int(segment_of.max(initial=-1)) + 1
    centre, scale_m = _extent(state)
    scaled = State(
        np.column_stack([(state.poses[:, :2] - centre) / scale_m, state.poses[:, 2]]),
        (state.tags - centre) / scale_m,
        state.calibration,
    )
    points = measured.tags
    together, apart = _of_tags(observations, columns, segment_of, n_segments, points, scaled.tags)
    rows = [
        _of_held_poses(columns, measured.starts, segment_of, n_segments, scaled),
        together,
        _of_distances(measured.distances, columns, segment_of, n_segments, points, scaled),
    ]
    n = 3 * n_segments + 2 * len(points)
    resistance = sum(row.T @ row for row in (_pad_columns(row, n) for row in rows))
    resisted, motions = linalg.eigh(resistance - _pad_columns(apart, n).T @ _pad_columns(apart, n))
    free = resisted <= _FREE * max(1.0, float(resisted.max(initial=0.0)))
    moves = np.linalg.norm(motions[: 3 * n_segments, free].reshape(n_segments, -1), axis=1) > _MOVES
    unread = np.bincount(observations.tag, minlength=len(columns.tags)) == 0
    n_unread = int((columns.tags[unread & ~np.isin(np.arange(len(unread)), points)] >= 0).sum())
    tags = np.flatnonzero(unread & (columns.tags >= 0).any(axis=1))
    return UnobservableDirections(
        int(free.sum()) + n_unread, tuple(np.flatnonzero(moves).tolist()), tuple(tags.tolist())
    )


def segments_of_poses(odometry: OdometryFactors, n_poses: int) -> IntArray:
    """(P,) number of the segment that each pose belongs to."""
    starts = np.ones(n_poses, dtype=np.int64)
    starts[odometry.first + 1] = 0
    return np.cumsum(starts) - 1


def _extent(state: State) -> tuple[FloatArray, float]:
    """Middle and size of the whole, so that turns and shifts are numbers of one size."""
    places = np.concatenate([state.poses[:, :2], state.tags])
    centre = places.mean(axis=0)
    return centre, float(np.abs(places - centre).max(initial=0.0)) or 1.0


def _of_held_poses(
    columns: Columns, starts: StartFactors, segment_of: IntArray, n_segments: int, scaled: State
) -> FloatArray:
    """How each held or measured direction of a pose moves with its segment's (x, y, turn) about the middle."""
    pose, direction = np.nonzero(columns.poses < 0)
    pose = np.concatenate([pose, np.repeat(starts.pose, 3)])
    direction = np.concatenate([direction, np.tile(np.arange(3), len(starts.pose))])
    x, y, theta = scaled.poses[pose].T
    cos, sin = np.cos(theta), np.sin(theta)
    along = np.stack([cos, sin, sin * x - cos * y], axis=-1)
    across = np.stack([-sin, cos, cos * x + sin * y], axis=-1)
    turn = np.broadcast_to([0.0, 0.0, 1.0], along.shape)
    return _scatter(np.choose(direction[:, None], [along, across, turn]), segment_of[pose], n_segments)


def _of_tags(
    observations: ObservationFactors,
    columns: Columns,
    segment_of: IntArray,
    n_segments: int,
    points: IntArray,
    place: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """B and S with B^T B - S^T S the square of how far tags, moved with the segments that read them, come apart."""
    segment, tag = np.unique(np.stack([segment_of[observations.pose], observations.tag]), axis=1)
    together, apart = [], []
    count = np.bincount(tag, minlength=len(place))
    is_point = np.isin(tag, points)
    for axis, turned in enumerate((-place[:, 1], place[:, 0])):
        moved = np.zeros((len(tag), 3))
        moved[:, axis], moved[:, 2] = 1.0, turned[tag]
        by_segment = _scatter(moved, segment, n_segments)
        # The best place for a tag is the mean of where its segments take it; a held one stays, a point is where it is.
        free = (columns.tags[tag, axis] >= 0) & ~is_point
        mean = sparse.csr_array((free / np.sqrt(count[tag]), (tag, np.arange(len(tag)))), shape=(len(place), len(tag)))
        apart.append(np.asarray(mean @ by_segment))
        own = np.zeros((len(tag), 2 * len(points)))
        own[is_point, 2 * np.searchsorted(points, tag[is_point]) + axis] = -1.0
        together.append(np.hstack([by_segment, own]))
    return np.concatenate(together), np.concatenate(apart)


def _of_distances(
    distances: DistanceFactors, columns: Columns, segment_of: IntArray, n_segments: int, points: IntArray, scaled: State
) -> FloatArray:
    """How each distance changes as its ends move, and that points which are held do not."""
    place_a, place_b = ends_of(distances, scaled)
    apart = place_b - place_a
    along = apart / np.maximum(np.linalg.norm(apart, axis=1), np.finfo(np.float64).tiny)[:, None]
    held = columns.tags[points].reshape(-1) < 0
    rows = np.zeros((len(along), 3 * n_segments + 2 * len(points)))
    ends = (distances.pose_a, distances.tag_a, place_a, -along), (distances.pose_b, distances.tag_b, place_b, along)
    for pose, tag, place, way in ends:
        for row in range(len(along)):
            if pose[row] >= 0:
                first = 3 * segment_of[pose[row]]
                turned = place[row, 0] * way[row, 1] - place[row, 1] * way[row, 0]
                rows[row, first : first + 3] += [*way[row], turned]
            else:
                first = 3 * n_segments + 2 * int(np.searchsorted(points, tag[row]))
                rows[row, first : first + 2] += way[row]
    return np.vstack([rows, np.eye(rows.shape[1])[3 * n_segments :][held]])


def _pad_columns(rows: FloatArray, n: int) -> FloatArray:
    """With as many columns of zeros as are missing."""
    return np.pad(rows, ((0, 0), (0, n - rows.shape[1])))


def _scatter(rows: FloatArray, segment: IntArray, n_segments: int) -> FloatArray:
    """Rows (N, 3) by the motion of one segment each, as rows (N, 3 n_segments) by those of all."""
    spread = np.zeros((len(rows), n_segments, 3))
    spread[np.arange(len(rows)), segment] = rows
    return spread.reshape(len(rows), 3 * n_segments)
