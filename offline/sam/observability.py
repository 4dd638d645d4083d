"""Observability: the directions of the state that change no residual, from which segments observe which tags.

Odometry makes each segment a rigid body, and a shared tag is a pin joint between the segments that observe it. A
segment without a shared tag has three free motions, one with a single shared tag can rotate about it, and so on. The
rank follows from these few bodies, and is therefore not affected by rounding in the normal equations of long segments.
A tag at the end of a measured distance is a body of its own, a point.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import linalg, sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, ObservationFactors, OdometryFactors, State
from groundsbot.offline.sam.factors.priors import DistanceFactors, Priors, StartFactors, ends_of

# Eigenvalue of an unobservable motion relative to the largest; rounding is a thousand times smaller.
_FREE: Final = 1e-12
_MOVES: Final = 1e-6


@dataclass(frozen=True)
class UnobservableDirections:
    """The directions of the state that no factor constrains.

    Attributes:
        n_directions: dimension of the unobservable subspace.
        segments: indices of segments, in the order of poses, that can move relative to the fixed variables.
        tags: indices of tags without observations.
    """

    n_directions: int
    segments: tuple[int, ...]
    tags: tuple[int, ...]


def find_unobservable(
    odometry: OdometryFactors, observations: ObservationFactors, measured: Priors, columns: Columns, state: State
) -> UnobservableDirections:
    """Find the motions of whole segments and of tags that change no residual.

    All calibration is observable by its prior.

    Args:
        odometry: factors of full rank.
        observations: factors of full rank in their tags.
        measured: factors of full rank.
        columns: columns of the variables; -1 where fixed.
        state: positions of segments and tags.
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
    together, apart = _rows_of_tags(observations, columns, segment_of, n_segments, points, scaled.tags)
    rows = [
        _rows_of_fixed_poses(columns, measured.starts, segment_of, n_segments, scaled),
        together,
        sparse.csr_array(_rows_of_distances(measured.distances, columns, segment_of, n_segments, points, scaled)),
    ]
    n = 3 * n_segments + 2 * len(points)
    matrix = np.zeros((n, n))
    for row in rows:
        matrix[: row.shape[1], : row.shape[1]] += (row.T @ row).toarray()
    matrix[: 3 * n_segments, : 3 * n_segments] -= (apart.T @ apart).toarray()
    eigenvalues, motions = linalg.eigh(matrix)
    free = eigenvalues <= _FREE * max(1.0, float(eigenvalues.max(initial=0.0)))
    moves = np.linalg.norm(motions[: 3 * n_segments, free].reshape(n_segments, -1), axis=1) > _MOVES
    unobserved = np.bincount(observations.tag, minlength=len(columns.tags)) == 0
    n_unobserved = int((columns.tags[unobserved & ~np.isin(np.arange(len(unobserved)), points)] >= 0).sum())
    tags = np.flatnonzero(unobserved & (columns.tags >= 0).any(axis=1))
    return UnobservableDirections(
        int(free.sum()) + n_unobserved, tuple(np.flatnonzero(moves).tolist()), tuple(tags.tolist())
    )


def segments_of_poses(odometry: OdometryFactors, n_poses: int) -> IntArray:
    """Return the index (P,) of the segment of each pose."""
    starts = np.ones(n_poses, dtype=np.int64)
    starts[odometry.first + 1] = 0
    return np.cumsum(starts) - 1


def _extent(state: State) -> tuple[FloatArray, float]:
    """Return centre (2,) and radius of all positions; scaled by it, rotations and translations are comparable."""
    places = np.concatenate([state.poses[:, :2], state.tags])
    centre = places.mean(axis=0)
    return centre, float(np.abs(places - centre).max(initial=0.0)) or 1.0


def _rows_of_fixed_poses(
    columns: Columns, starts: StartFactors, segment_of: IntArray, n_segments: int, scaled: State
) -> sparse.csr_array:
    """Return rows (N, 3 S): each fixed or measured direction of a pose by its segment's (x, y, theta)."""
    pose, direction = np.nonzero(columns.poses < 0)
    pose = np.concatenate([pose, np.repeat(starts.pose, 3)])
    direction = np.concatenate([direction, np.tile(np.arange(3), len(starts.pose))])
    x, y, theta = scaled.poses[pose].T
    cos, sin = np.cos(theta), np.sin(theta)
    along = np.stack([cos, sin, sin * x - cos * y], axis=-1)
    across = np.stack([-sin, cos, cos * x + sin * y], axis=-1)
    turn = np.broadcast_to([0.0, 0.0, 1.0], along.shape)
    return _scatter(np.choose(direction[:, None], [along, across, turn]), segment_of[pose], n_segments)


def _rows_of_tags(
    observations: ObservationFactors,
    columns: Columns,
    segment_of: IntArray,
    n_segments: int,
    points: IntArray,
    place: FloatArray,
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return B and S such that B^T B - S^T S is the sum of squared distances of each tag's images in its segments."""
    segment, tag = np.unique(np.stack([segment_of[observations.pose], observations.tag]), axis=1)
    together, apart = [], []
    count = np.bincount(tag, minlength=len(place))
    is_point = np.isin(tag, points)
    for axis, turned in enumerate((-place[:, 1], place[:, 0])):
        moved = np.zeros((len(tag), 3))
        moved[:, axis], moved[:, 2] = 1.0, turned[tag]
        by_segment = _scatter(moved, segment, n_segments)
        # A free tag moves to the mean of its images; fixed tags and points do not.
        free = (columns.tags[tag, axis] >= 0) & ~is_point
        mean = sparse.csr_array((free / np.sqrt(count[tag]), (tag, np.arange(len(tag)))), shape=(len(place), len(tag)))
        apart.append(mean @ by_segment)
        of_points = np.flatnonzero(is_point), 2 * np.searchsorted(points, tag[is_point]) + axis
        own = sparse.csr_array((-np.ones(len(of_points[0])), of_points), shape=(len(tag), 2 * len(points)))
        together.append(sparse.hstack([by_segment, own]))
    return sparse.csr_array(sparse.vstack(together)), sparse.csr_array(sparse.vstack(apart))


def _rows_of_distances(
    distances: DistanceFactors, columns: Columns, segment_of: IntArray, n_segments: int, points: IntArray, scaled: State
) -> FloatArray:
    """Return rows: the change of each distance by the motion of its ends, and the motion of fixed points."""
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


def _scatter(rows: FloatArray, segment: IntArray, n_segments: int) -> sparse.csr_array:
    """Return rows (N, 3 n_segments) by all segments from rows (N, 3) by one segment each."""
    column = 3 * segment[:, None] + np.arange(3)
    values = rows.reshape(-1), column.reshape(-1), 3 * np.arange(len(rows) + 1)
    return sparse.csr_array(values, shape=(len(rows), 3 * n_segments))
