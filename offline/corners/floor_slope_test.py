"""Segments of a drive that are not level with the rest, a ramp or another floor: found and said, not modelled.

All drives are taken to be on one floor, off level anew in each picture by the floor's sigmas. Let all pictures of a
segment stand off by the same roll, pitch and height m besides. At the solution the slope of the cost by m is
g = B^T V^-1 r, with V the corners' covariance, how single pictures stand included, and what all else leaves of the
information about m is L = B^T V^-1 B - C H^-1 C^T, with C = B^T V^-1 J: a score test, exact to first order, and without
another solve (Rao, "Large sample tests of statistical hypotheses", 1948). A segment whose tags nobody sees from
elsewhere has L = 0: they took the slope for their own.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from math import degrees
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.problem import LOOKS
from groundsbot.offline.corners.solver import CornerSolution
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, Segment
from groundsbot.offline.sam import Graph

# Of way, or of turning; a ramp is longer, and a bump is none.
_STRETCH_M: Final = 2.0
_STRETCH_RAD: Final = 1.0
# One false word in a hundred maps (Bonferroni over all segments).
_FALSE_ALARM: Final = 0.01
# Squared sigmas: of level segments, whose poses and tags are estimated, less than a tenth look so much off.
_MAY_BE: Final = float(chi2.isf(0.1, 3))
# rad, rad and m: what is known no better than this is not known.
_COARSE: Final = np.array([0.1, 0.1, 0.5])


class _Pictures(NamedTuple):
    """What the looks of each of P pictures say of how it stands, single pictures' standing eliminated.

    Attributes:
        pose: (P,) keyframe; slope: (P, 3) of the cost; information: (P, 3, 3).
        picture_of: (M,) of each observation; coupled: (M, 3, 18) with its columns (M, 18).
        range_m: (P,) to the tags, in the mean.
    """

    pose: IntArray
    slope: FloatArray
    information: FloatArray
    picture_of: IntArray
    coupled: FloatArray
    columns: IntArray
    range_m: FloatArray


class _OffLevel(NamedTuple):
    """How far a segment is off in roll, pitch and height, with sigmas; in squared sigmas, and their freedom."""

    off: FloatArray
    sigma: FloatArray
    square: float
    freedom: int


def segments_off_level(graph: Graph, solution: CornerSolution) -> list[str]:
    """A sentence for each segment of a segment that stands otherwise than the rest, beyond the floor's own sigmas.

    The worst is taken first and the others judged given it: what a ramp bends looks off level too.
    """
    if solution.factor is None:
        return []
    pictures = _pictures(solution)
    firsts = graph.first_pose.tolist()
    cut = [
        each for segment, first in zip(graph.segments, firsts, strict=True) for each in _cut(segment, first, pictures)
    ]
    asked = _show(pictures, cut)
    couplings = [_coupling(pictures, each, solution.problem.columns.n) for each in asked]
    taken = solution.factor.whiten(np.concatenate([np.zeros((0, solution.problem.columns.n)), *couplings]))
    cross = (taken @ taken.T).reshape(len(asked), 3, len(asked), 3).swapaxes(1, 2)
    slope = np.array([pictures.slope[each].sum(axis=0) for each in asked]).reshape(-1, 3)
    left = -cross
    for k, each in enumerate(asked):
        left[k, k] += pictures.information[each].sum(axis=0)
    found: dict[int, _OffLevel] = {}
    while len(found) < len(asked):
        judged = {
            k: _off_level(slope[k], left[k, k], float(pictures.range_m[asked[k]].mean()))
            for k in range(len(asked))
            if k not in found
        }
        counting = {k: each for k, each in judged.items() if each is not None and _counts(each, solution, len(cut))}
        if not counting:
            break
        worst = max(counting, key=lambda k: counting[k].square)
        found[worst] = counting[worst]
        gain = left[:, worst] @ np.linalg.pinv(left[worst, worst], hermitian=True)
        slope, left = slope - gain @ slope[worst], left - np.einsum("kab,jcb->kjac", gain, left[:, worst])
    return [
        _sentence(graph, asked[k], found[k], pictures, solution) for k in sorted(found, key=lambda k: -found[k].square)
    ]


def _pictures(solution: CornerSolution) -> _Pictures:
    problem, state, found = solution.problem, solution.state, solution.pictures
    picture, looks = found.picture, problem.corners.observations
    n = len(found.own)
    pose = np.zeros(n, dtype=np.int64)
    pose[picture] = looks.pose
    off_m = state.tags[looks.tag] - state.poses[looks.pose, :2]
    range_m = np.bincount(picture, np.hypot(off_m[:, 0], off_m[:, 1]), n) / np.bincount(picture, minlength=n)
    columns = problem.order.kinds[LOOKS].columns
    if not problem.attitude_sigmas.any():  # quicker than by what follows
        return _Pictures(pose, found.force, found.own, picture, found.coupled, columns, range_m)
    spread = np.linalg.inv(np.eye(3) + found.own * problem.attitude_sigmas**2)
    slope = np.asarray((spread @ found.force[..., None])[..., 0], dtype=np.float64)
    return _Pictures(pose, slope, spread @ found.own, picture, spread[picture] @ found.coupled, columns, range_m)


def _cut(segment: Segment, first: int, pictures: _Pictures) -> list[slice]:
    """Pictures of a segment, cut by the way driven and by what was turned."""
    steps = np.maximum(segment.odometry.distance_m / _STRETCH_M, np.abs(segment.odometry.motion[:, 2]) / _STRETCH_RAD)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    begin, end = np.searchsorted(pictures.pose, [first, first + len(along)]).tolist()
    cell = along[pictures.pose[begin:end] - first].astype(np.int64)
    bounds = [begin, *(begin + 1 + np.flatnonzero(np.diff(cell))).tolist(), end]
    return [slice(*each) for each in pairwise(bounds)] if end > begin else []


def _show(pictures: _Pictures, cut: Sequence[slice]) -> list[slice]:
    """Segments that might be off: as good as certain poses and tags are not, they can only look less so."""
    first = [each.start for each in cut]  # each picture is of one segment
    slope, information = np.add.reduceat(pictures.slope, first), np.add.reduceat(pictures.information, first)
    square = np.einsum("ci,cij,cj->c", slope, np.linalg.pinv(information, hermitian=True), slope)
    return [cut[c] for c in np.flatnonzero(square > _MAY_BE).tolist()]


def _coupling(pictures: _Pictures, which: slice, n: int) -> FloatArray:
    """C (3, n) of a segment."""
    looks = np.flatnonzero((pictures.picture_of >= which.start) & (pictures.picture_of < which.stop))
    coupled = np.zeros((3, n + 1))  # the last takes what is held
    for k in range(3):
        np.add.at(coupled[k], pictures.columns[looks], pictures.coupled[looks, k])
    return coupled[:, :n]


def _off_level(slope: FloatArray, left: FloatArray, range_m: float) -> _OffLevel | None:
    """None where nothing is known of how the segment lies to the rest."""
    unit = np.diag(_COARSE)
    values, ways = np.linalg.eigh(unit @ (0.5 * (left + left.T)) @ unit)
    known = values > 1.0
    if not known.any():
        return None
    ways, values = unit @ ways[:, known], values[known]
    off = -(ways.T @ slope) / values
    turned = UNMODELLED_SIGMA_M / range_m
    back = np.linalg.pinv(ways)
    covariance = np.diag(1.0 / values) + back @ np.diag([turned, turned, UNMODELLED_SIGMA_M]) ** 2 @ back.T
    sigma = np.sqrt(np.diag(ways @ covariance @ ways.T))
    return _OffLevel(ways @ off, sigma, float(off @ np.linalg.solve(covariance, off)), int(known.sum()))


def _counts(part: _OffLevel, solution: CornerSolution, n: int) -> bool:
    """Whether chance does not explain it, and it is more than the floor is uneven by from picture to picture."""
    beyond = bool((np.abs(part.off) > solution.problem.attitude_sigmas).any())
    return beyond and part.square > _by_chance(n, part.freedom)


@lru_cache(maxsize=64)
def _by_chance(n: int, freedom: int) -> float:
    """Squared sigmas that none of n level segments reaches, but for a false alarm."""
    return float(chi2.isf(_FALSE_ALARM / n, freedom))


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
        f"({degrees(d_roll):.1f}), height {height_m:+.2f} m ({d_height_m:.2f}): a ramp or another floor? The map takes "
        "all for one level floor, and is bent there; leave that part of the drive out"
    )
