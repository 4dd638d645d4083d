"""Which tags do not hang upright, by what is left over of the upright model, a camera's turn that all share taken out.

A camera that sits turned by more or less than its mount's file says sees every tag lean. So the turn that explains all
looks of a run best comes first, roll and pitch under the prior of robot.yaml: tags that lean are outvoted (Geman and
McClure's weights, by what a tag leaves over as a whole), and a turn that the prior rules out is no turn of the camera.
"""

from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.measurements.sensor_model.tag_pose import TagMeasurements

UPRIGHT_DOF: Final = 2
FALSE_ALARM: Final = 1e-6
_MEDIAN_CHI2: Final = float(2.0 * np.log(2.0))  # of two degrees of freedom
# By so many the level of a sigma that was given is known to some 15 %; by fewer, a lucky few could make it too small.
_OBSERVATIONS_FOR_LEVEL: Final = 100
# No detector is so much better than it is said to be; what is left over of exact corners is the arcs and lenses' own.
_LEAST_LEVEL: Final = 1.0 / 20.0**2
# A corner's noise is not exactly Gaussian: only a tag whose residuals are this many times those of its own general
# pose, which has as many degrees of freedom, is said to hang askew. A tag that leans by half a right angle and is seen
# from a few metres does not stay below it.
_ASKEW_FACTOR: Final = 2.5
# One spoilt picture counts little beside a tag's others.
_MOST_CHI2: Final = 100.0
_FARTHEST: Final = float(np.sqrt(chdtri(2, 1e-4)))  # sigmas: a mount is turned by more so rarely
_ROUNDS: Final = 10
_SETTLED: Final = 1e-2  # sigmas of the prior


def with_common_turn(found: TagMeasurements, tag: IntArray, by_mount: FloatArray, sigma: FloatArray) -> FloatArray:
    """(M,) squared whitened residuals of the upright model, with the camera turned as all looks have it in common.

    A tag that hangs upright as the file has the mount does so, turn or no turn: with next to no noise in the corners
    even what a leaning tag contributes to the turn would be too much for the others.

    Args:
        found: by the upright model.
        tag: (M,) an index each.
        by_mount: (2, 3) axes in base about which the mount's roll and pitch turn it.
        sigma: (2,) of these, rad.
    """
    by_turn = found.misfit_by_turn @ by_mount.T * sigma  # by sigmas of the prior
    usable = np.asarray(np.isfinite(found.misfit).all(-1) & np.isfinite(by_turn).all((-1, -2)))
    misfit, by_turn, all_tags, tag = found.misfit[usable], by_turn[usable], tag, tag[usable]
    own = np.einsum("mki,mkj->mij", by_turn, by_turn)
    force = np.einsum("mki,mk->mi", by_turn, misfit)
    turn, chi2 = np.zeros(2), found.chi2[usable]
    for _ in range(_ROUNDS):
        level = max(level_of(chi2), 1.0)
        _, mean = _mean_chi2(tag, chi2 / level)
        weight = (1.0 / (level * (1.0 + mean) ** 2))[tag]
        information = np.eye(2) + np.einsum("m,mij->ij", weight, own)
        before, turn = turn, -np.linalg.solve(information, weight @ force)
        turn = turn * (_FARTHEST / max(float(np.linalg.norm(turn)), _FARTHEST))
        chi2 = ((misfit + by_turn @ turn) ** 2).sum(axis=-1)
        if np.abs(turn - before).max() < _SETTLED:
            break
    turned = found.chi2.copy()
    turned[usable] = chi2
    (_, as_filed), (_, as_turned) = _mean_chi2(all_tags, found.chi2), _mean_chi2(all_tags, turned)
    return np.where((as_turned < as_filed)[all_tags], turned, found.chi2)


def are_tilted(tag: IntArray, chi2: FloatArray) -> IntArray:
    """Tags that the upright model does not explain."""
    count, mean = _mean_chi2(tag, chi2)
    dof = UPRIGHT_DOF * np.maximum(count, 1)
    limit = np.maximum(_ASKEW_FACTOR, chdtri(dof, FALSE_ALARM) / dof)
    return np.flatnonzero((count > 0) & (mean > limit))


def find_tilted(tag: IntArray, upright_chi2: FloatArray, general_chi2: FloatArray, is_doubted: BoolArray) -> IntArray:
    """Those of the doubted tags that hanging askew explains far better: bad corners alone spoil both poses."""
    if not is_doubted.any():
        return np.zeros(0, dtype=np.int64)
    _, upright = _mean_chi2(tag[is_doubted], upright_chi2[is_doubted])
    _, general = _mean_chi2(tag[is_doubted], general_chi2[is_doubted])
    return np.flatnonzero(upright > _ASKEW_FACTOR * np.maximum(general, 1.0))


def level_of(chi2: FloatArray) -> float:
    """How many times residuals of observations, most of them good, are what the corners' sigma makes expect."""
    finite = chi2[np.isfinite(chi2)]
    if not len(finite):
        return 1.0
    level = max(float(np.median(finite)) / _MEDIAN_CHI2, _LEAST_LEVEL)
    return level if len(finite) >= _OBSERVATIONS_FOR_LEVEL else max(1.0, level)


def _mean_chi2(tag: IntArray, chi2: FloatArray) -> tuple[IntArray, FloatArray]:
    """(T,) observations of each tag, and their mean per degree of freedom, capped."""
    capped = np.where(np.isfinite(chi2), np.minimum(chi2, _MOST_CHI2), _MOST_CHI2)
    count = np.bincount(tag)
    return count, np.bincount(tag, capped) / (UPRIGHT_DOF * np.maximum(count, 1))
