"""Score test for windows of a drive that are not level with the rest, such as a ramp or another floor.

All drives are assumed to be on one floor, with independent attitude and height of each image by the floor's sigmas. The
alternative adds a common roll, pitch and height m to all images of a window. At the solution the gradient of the cost
by m is g = B^T V^-1 r, with V the corners' marginal covariance. The marginal information about m is
L = B^T V^-1 B - C H^-1 C^T, with C = B^T V^-1 J. This score test is exact to first order and needs no other solve (Rao,
"Large sample tests of statistical hypotheses", 1948). A window whose tags are not detected from elsewhere has L = 0,
since the tags' poses absorb the slope.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from math import degrees
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.problem import DETECTIONS
from groundsbot.offline.corners.solver import CornerSolution
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, Segment
from groundsbot.offline.sam import Graph

# Length of a window, in distance or rotation: shorter than a ramp, longer than a bump.
_WINDOW_M: Final = 2.0
_WINDOW_RAD: Final = 1.0
# False alarm rate of a map (Bonferroni over all windows).
_FALSE_ALARM: Final = 0.01
# In squared sigmas; fewer than a tenth of level windows exceed it with estimated poses and tags.
_CANDIDATE: Final = float(chdtri(3, 0.1))
# rad, rad and m: directions with a larger sigma count as unobservable.
_COARSE: Final = np.array([0.1, 0.1, 0.5])


class _Pictures(NamedTuple):
    """Gradient and information of each of P images by a common ATTITUDE, with that of single images eliminated.

    Attributes:
        pose: (P,) keyframe.
        slope: (P, 3) gradient of the cost.
        information: (P, 3, 3) information.
        picture_of: (M,) image of each detection.
        coupled: (M, 3, 19) information between ATTITUDE and the columns of each detection.
        columns: (M, 19) columns of each detection.
        range_m: (P,) mean distance to the tags.
    """

    pose: IntArray
    slope: FloatArray
    information: FloatArray
    picture_of: IntArray
    coupled: FloatArray
    columns: IntArray
    range_m: FloatArray


class _OffLevel(NamedTuple):
    """Estimated roll, pitch and height of a window, their sigmas, the chi-square and its degrees of freedom."""

    off: FloatArray
    sigma: FloatArray
    square: float
    freedom: int


def segments_off_level(graph: Graph, solution: CornerSolution) -> list[str]:
    """Return a warning for each window that is not level with the rest, beyond the floor's sigmas.

    The most significant window is accepted first, and the others are tested given it, since a ramp also bends the map
    around it.
    """
    if solution.factor is None:
        return []
    pictures = _pictures(solution)
    firsts = graph.first_pose.tolist()
    parts = zip(graph.segments, firsts, strict=True)
    windows = [each for segment, first in parts for each in _windows(segment, first, pictures)]
    tested = _candidates(pictures, windows)
    couplings = [_coupling(pictures, each, solution.problem.columns.n) for each in tested]
    whitened = solution.factor.whiten(np.concatenate([np.zeros((0, solution.problem.columns.n)), *couplings]))
    cross = (whitened @ whitened.T).reshape(len(tested), 3, len(tested), 3).swapaxes(1, 2)
    slope = np.array([pictures.slope[each].sum(axis=0) for each in tested]).reshape(-1, 3)
    remaining = -cross
    for k, each in enumerate(tested):
        remaining[k, k] += pictures.information[each].sum(axis=0)
    found: dict[int, _OffLevel] = {}
    while len(found) < len(tested):
        estimates = {
            k: _off_level(slope[k], remaining[k, k], float(pictures.range_m[tested[k]].mean()))
            for k in range(len(tested))
            if k not in found
        }
        significant = {
            k: each for k, each in estimates.items() if each and _is_significant(each, solution, len(windows))
        }
        if not significant:
            break
        worst = max(significant, key=lambda k: significant[k].square)
        found[worst] = significant[worst]
        gain = remaining[:, worst] @ np.linalg.pinv(remaining[worst, worst], hermitian=True)
        slope = slope - gain @ slope[worst]
        remaining = remaining - np.einsum("kab,jcb->kjac", gain, remaining[:, worst])
    return [
        _sentence(graph, tested[k], found[k], pictures, solution) for k in sorted(found, key=lambda k: -found[k].square)
    ]


def _pictures(solution: CornerSolution) -> _Pictures:
    problem, state, found = solution.problem, solution.state, solution.pictures
    picture, detections = found.picture, problem.corners.observations
    n = len(found.own)
    pose = np.zeros(n, dtype=np.int64)
    pose[picture] = detections.pose
    off_m = state.tags[detections.tag] - state.poses[detections.pose, :2]
    range_m = np.bincount(picture, np.hypot(off_m[:, 0], off_m[:, 1]), n) / np.bincount(picture, minlength=n)
    columns = problem.order.kinds[DETECTIONS].columns
    if not problem.attitude_sigmas.any():  # the same as below, without inverses of the identity
        return _Pictures(pose, found.force, found.own, picture, found.coupled, columns, range_m)
    shrinkage = np.linalg.inv(np.eye(3) + found.own * problem.attitude_sigmas**2)
    slope = np.asarray((shrinkage @ found.force[..., None])[..., 0], dtype=np.float64)
    return _Pictures(pose, slope, shrinkage @ found.own, picture, shrinkage[picture] @ found.coupled, columns, range_m)


def _windows(segment: Segment, first: int, pictures: _Pictures) -> list[slice]:
    """Return slices of a segment's images, windows by distance and rotation."""
    steps = np.maximum(segment.odometry.distance_m / _WINDOW_M, np.abs(segment.odometry.motion[:, 2]) / _WINDOW_RAD)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    begin, end = np.searchsorted(pictures.pose, [first, first + len(along)]).tolist()
    cell = along[pictures.pose[begin:end] - first].astype(np.int64)
    bounds = [begin, *(begin + 1 + np.flatnonzero(np.diff(cell))).tolist(), end]
    return [slice(*each) for each in pairwise(bounds)] if end > begin else []


def _candidates(pictures: _Pictures, windows: Sequence[slice]) -> list[slice]:
    """Return windows that are significant for fixed poses and tags; estimating these can only reduce the chi-square."""
    first = [each.start for each in windows]  # the windows partition the images
    slope, information = np.add.reduceat(pictures.slope, first), np.add.reduceat(pictures.information, first)
    square = np.einsum("ci,cij,cj->c", slope, np.linalg.pinv(information, hermitian=True), slope)
    return [windows[c] for c in np.flatnonzero(square > _CANDIDATE).tolist()]


def _coupling(pictures: _Pictures, which: slice, n: int) -> FloatArray:
    """Return C (3, n) of a window."""
    detections = np.flatnonzero((pictures.picture_of >= which.start) & (pictures.picture_of < which.stop))
    coupled = np.zeros((3, n + 1))  # the last entry collects fixed columns
    for k in range(3):
        np.add.at(coupled[k], pictures.columns[detections], pictures.coupled[detections, k])
    return coupled[:, :n]


def _off_level(slope: FloatArray, remaining: FloatArray, range_m: float) -> _OffLevel | None:
    """Return the estimate of a window, or None if its attitude relative to the rest is unobservable."""
    unit = np.diag(_COARSE)
    values, directions = np.linalg.eigh(unit @ (0.5 * (remaining + remaining.T)) @ unit)
    known = values > 1.0
    if not known.any():
        return None
    directions, values = unit @ directions[:, known], values[known]
    off = -(directions.T @ slope) / values
    tilt_rad = UNMODELLED_SIGMA_M / range_m
    back = np.linalg.pinv(directions)
    covariance = np.diag(1.0 / values) + back @ np.diag([tilt_rad, tilt_rad, UNMODELLED_SIGMA_M]) ** 2 @ back.T
    sigma = np.sqrt(np.diag(directions @ covariance @ directions.T))
    return _OffLevel(directions @ off, sigma, float(off @ np.linalg.solve(covariance, off)), int(known.sum()))


def _is_significant(part: _OffLevel, solution: CornerSolution, n: int) -> bool:
    """Return whether a window is significant, and further off level than single images by the floor's sigmas."""
    beyond = bool((np.abs(part.off) > solution.problem.attitude_sigmas).any())
    return beyond and part.square > _threshold(n, part.freedom)


@lru_cache(maxsize=64)
def _threshold(n: int, freedom: int) -> float:
    """Return the chi-square that the largest of n level windows exceeds with the false alarm rate."""
    return float(chdtri(freedom, _FALSE_ALARM / n))


def _sentence(graph: Graph, which: slice, part: _OffLevel, pictures: _Pictures, solution: CornerSolution) -> str:
    poses = pictures.pose[which]
    index = int(np.searchsorted(graph.first_pose, poses[0], side="right")) - 1
    segment, first = graph.segments[index], int(graph.first_pose[index])
    begin_s, end_s = (segment.stamps_ns[poses[[0, -1]] - first] - segment.stamps_ns[0]) * 1e-9
    x_m, y_m = solution.state.poses[poses, :2].mean(axis=0)
    (roll, pitch, height_m), (d_roll, d_pitch, d_height_m) = part.off, part.sigma
    return (
        f"{segment.name} is not level with the rest from {begin_s:.0f} to {end_s:.0f} s, about ({x_m:.1f}, {y_m:.1f}) "
        f"m: pitch {degrees(pitch):+.1f} deg (sigma {degrees(d_pitch):.1f}), roll {degrees(roll):+.1f} deg "
        f"({degrees(d_roll):.1f}), height {height_m:+.2f} m ({d_height_m:.2f}), as on a ramp or another floor. "
        "The map assumes one level floor and is bent there; leave that part of the drive out"
    )
