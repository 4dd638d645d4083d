"""What the fit of a component says about its tags, readings and motions: places, misreads, and motions of no weight.

Everything is judged last and by the fit's own distributions. A place is far if its distance has a small probability
under a Student-t distribution with four degrees of freedom, whose scale is that of the fit and of the place's own
uncertainty; over all places of a map at most one in a hundred of those named is named by chance (Benjamini and Hochberg
1995).
"""

from typing import Final, NamedTuple

import numpy as np
from scipy import stats

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.estimate.estimate import Joint
from groundsbot.offline.estimate.kernels import errors_of_motions, selected_inverse, trace_ties
from groundsbot.offline.estimate.problem import NU, NU_PLACES
from groundsbot.offline.measurements import TagKey

_FALSE_DISCOVERIES: Final = 0.01
_NEAR_SIGMAS: Final = 5.0
_MOUNTED_M: Final = 0.05  # sigma of where one tag is hung in place of another
_APART: Final = 0.5  # places nearer to each other than this share of their distance from the joint place are one


class ElsewherePlace(NamedTuple):
    """A place where some drives have a tag, far from the joint place.

    Attributes:
        tag: the tag.
        drives: indices in the component.
        point: point of the place.
        off_m: distance from the joint place.
        sigmas: the same in its scale.
        instead_of: the other tag that has its joint place there, if any.
    """

    tag: TagKey
    drives: tuple[int, ...]
    point: int
    off_m: float
    sigmas: float
    instead_of: TagKey | None


class Misread(NamedTuple):
    """Readings of one pass that are of another place than their tag's."""

    drive: int
    tag: TagKey
    really: TagKey | None
    n_readings: int
    point: int


class FreeMotion(NamedTuple):
    """A motion that the wheels do not tell: lifted, pushed, slipped."""

    drive: int
    stamp_ns: int
    off_m: float
    off_rad: float


class FitFindings(NamedTuple):
    """What was found in a component."""

    elsewhere: tuple[ElsewherePlace, ...]
    misread: tuple[Misread, ...]
    free_motions: tuple[FreeMotion, ...]


def find(joint: Joint) -> FitFindings:
    """Return what the fit of a component says."""
    problem, values = joint.problem, joint.values
    nodes, kinds = joint.factor.order.nodes, joint.factor.order.kinds
    Z = selected_inverse(nodes, joint.factor.entries)
    unused = np.zeros(joint.factor.order.n)
    found = []
    for ties, kind, nu in ((problem.joint_ties, kinds[2], NU_PLACES), (problem.pass_ties, kinds[3], NU)):
        h = trace_ties(ties, kind, values, nu, nodes, Z, unused)
        found.append((values.points[ties.case] - values.points[ties.general], ties.sigma * np.sqrt(1.0 + 0.5 * h)))
    of_drives, of_passes = found
    return FitFindings(
        tuple(_elsewhere(joint, *of_drives)), tuple(_misread(joint, *of_passes)), tuple(_free_motions(joint))
    )


def _far(off: FloatArray, scale_m: FloatArray) -> BoolArray:
    """Return which offsets (M, 2) are far."""
    Q = (off**2).sum(axis=1) / scale_m**2
    return _discoveries((1.0 + Q / NU) ** (-0.5 * NU))


def _discoveries(probability: FloatArray) -> BoolArray:
    """Return which hypotheses are rejected at the rate of false discoveries (Benjamini and Hochberg 1995)."""
    order = np.argsort(probability)
    bound = _FALSE_DISCOVERIES * np.arange(1, len(order) + 1) / max(len(order), 1)
    below = np.flatnonzero(probability[order] <= bound)
    found = np.zeros(len(order), dtype=np.bool_)
    found[order[: below[-1] + 1 if len(below) else 0]] = True
    return found


def _elsewhere(joint: Joint, off: FloatArray, scale_m: FloatArray) -> list[ElsewherePlace]:
    layout, points = joint.problem.layout, joint.values.points
    far = _far(off, scale_m)
    found: list[ElsewherePlace] = []
    for k in sorted(set(layout.tie[far, 1].tolist())):
        own = np.flatnonzero(far & (layout.tie[:, 1] == k)).tolist()
        tag = layout.joint[k - len(layout.own)]
        while own:
            first = own[0]
            length_m = float(np.hypot(*off[first]))
            same = [i for i in own if np.hypot(*(off[i] - off[first])) < _APART * length_m]
            own = [i for i in own if i not in same]
            near_m = _NEAR_SIGMAS * float(np.hypot(scale_m[first], _MOUNTED_M))
            place = points[layout.tie[first, 0]]
            drives = tuple(layout.own[layout.tie[i, 0]].drive for i in same)
            sigmas, other = length_m / float(scale_m[first]), _tag_at(joint, place, near_m, tag)
            found.append(ElsewherePlace(tag, drives, int(layout.tie[first, 0]), length_m, sigmas, other))
    return found


def _tag_at(joint: Joint, place: FloatArray, near_m: float, but: TagKey) -> TagKey | None:
    """Return the other tag whose place in the map is nearest, if it is near."""
    off_m = np.hypot(*(joint.tags_m - place).T)
    off_m[[i for i, tag in enumerate(joint.tags) if tag == but]] = np.inf
    return joint.tags[int(np.argmin(off_m))] if len(off_m) and off_m.min() < near_m else None


def _misread(joint: Joint, off: FloatArray, scale_m: FloatArray) -> list[Misread]:
    layout, values = joint.problem.layout, joint.values
    found = []
    for i in np.flatnonzero(_far(off, scale_m)).tolist():
        own, point = layout.own[layout.of_pass[i]], layout.n_places + i
        near_m = _NEAR_SIGMAS * float(np.hypot(scale_m[i], _MOUNTED_M))
        really = _tag_at(joint, values.points[point], near_m, own.tag)
        found.append(Misread(own.drive, own.tag, really, int((joint.problem.readings.point == point).sum()), point))
    return found


def _free_motions(joint: Joint) -> list[FreeMotion]:
    problem = joint.problem
    e, _ = errors_of_motions(problem.motions, joint.values, NU)
    probability = 2.0 * stats.t.sf(np.abs(e), NU)
    which: IntArray = np.flatnonzero(_discoveries(probability.reshape(-1)).reshape(-1, 3).any(axis=1))
    drive_of = np.searchsorted(problem.layout.first_pose, problem.motions.first[which], side="right") - 1
    found = []
    for m, d in zip(which.tolist(), drive_of.tolist(), strict=True):
        along, across, turn = (e[m] * problem.motions.sigma[m]).tolist()
        at = int(problem.motions.first[m] - problem.layout.first_pose[d])
        stamp_ns = int(problem.drives[d].segment.stamps_ns[at + 1])
        found.append(FreeMotion(d, stamp_ns, float(np.hypot(along, across)), turn))
    return found
