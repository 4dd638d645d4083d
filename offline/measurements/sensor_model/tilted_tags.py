"""Finds tags that are not mounted upright, from the residuals of the upright model.

An error of the camera's mount makes every tag appear tilted. The roll and pitch that explain all observations of a run
best are therefore estimated first, under the prior of robot.yaml. The estimate is robust against tilted tags, and
against a wrong prior, by the weights of Geman and McClure, applied to the mean residual of each tag and of the prior.
"""

from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.measurements.sensor_model.tag_pose import TagMeasurements

UPRIGHT_DOF: Final = 2
FALSE_ALARM: Final = 1e-6
_MEDIAN_CHI2: Final = float(2.0 * np.log(2.0))  # of two degrees of freedom
# This many observations determine the ratio of true to assumed variance to 15 %; from fewer it may be far too small.
_OBSERVATIONS_FOR_LEVEL: Final = 100
# No detector is better by more than this. Smaller residuals are those of the arcs and lens models.
_LEAST_LEVEL: Final = 1.0 / 20.0**2
# Corner noise is not exactly Gaussian, so a tag is tilted only if its squared residuals are this many times those of
# its general pose, which has as many degrees of freedom. A tag tilted by 45 degrees and seen from a few metres is
# above this.
_TILTED_FACTOR: Final = 2.5
# Limits the influence of a single bad picture on its tag.
_MOST_CHI2: Final = 100.0
_FARTHEST: Final = 12.0
# Mean residuals at which a tag loses weight, in order. All tags count at first (graduated non-convexity, Yang et al.,
# 2020): otherwise a large error of the mount, by which no tag seems upright, would not be found.
SCALES: Final = (_MOST_CHI2 / UPRIGHT_DOF, 12.0, 3.0, 1.0)
_ROUNDS: Final = 10
_STEP_TOLERANCE: Final = 1e-2  # sigmas of the prior


def common_turn(
    turned: TagMeasurements, at: FloatArray, tag: IntArray, by_mount: FloatArray, sigma: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray]:
    """Return the error (2,) of the mount's roll and pitch, and (M,) squared whitened residuals without it.

    Args:
        turned: (M,) by the upright model, with the mount turned by `at`.
        at: (2,) roll and pitch, in sigmas of the prior; so is the error that is returned.
        tag: (M,) index of the tag of each.
        by_mount: (2, 3) axes in base of the mount's roll and pitch.
        sigma: (2,) prior sigmas of the mount's roll and pitch, rad.
        scale: one of `SCALES`.
    """
    by_turn = turned.misfit_by_turn @ by_mount.T * sigma  # in sigmas of the prior
    usable = np.asarray(np.isfinite(turned.misfit).all(-1) & np.isfinite(by_turn).all((-1, -2)))
    misfit, by_turn, tag = turned.misfit[usable], by_turn[usable], tag[usable]
    hessians = np.einsum("mki,mkj->mij", by_turn, by_turn)
    gradients = np.einsum("mki,mk->mi", by_turn, misfit) - hessians @ at
    turn, chi2 = at, turned.chi2[usable]
    for _ in range(_ROUNDS):
        level = max(level_of(chi2), 1.0) if scale == 1.0 else 1.0
        _, mean = _mean_chi2(tag, chi2 / level)
        weight = (1.0 / (level * (1.0 + mean / scale) ** 2))[tag]
        of_prior = 1.0 / (1.0 + float(turn @ turn) / (UPRIGHT_DOF * scale)) ** 2
        information = of_prior * np.eye(2) + np.einsum("m,mij->ij", weight, hessians)
        before, turn = turn, -np.linalg.solve(information, weight @ gradients)
        turn = turn * (_FARTHEST / max(float(np.linalg.norm(turn)), _FARTHEST))
        chi2 = ((misfit + by_turn @ (turn - at)) ** 2).sum(axis=-1)
        if np.abs(turn - before).max() < _STEP_TOLERANCE:
            break
    corrected = turned.chi2.copy()
    corrected[usable] = chi2
    return turn, corrected


def smaller_by_tag(tag: IntArray, nominal: FloatArray, corrected: FloatArray) -> FloatArray:
    """Return (M,) squared residuals with the common error of the mount removed from the tags that then fit better.

    Where corners have very little noise, even the downweighted effect of a tilted tag on the correction would make the
    other tags appear tilted.
    """
    (_, nominal_mean), (_, corrected_mean) = _mean_chi2(tag, nominal), _mean_chi2(tag, corrected)
    return np.where((corrected_mean < nominal_mean)[tag], corrected, nominal)


def are_tilted(tag: IntArray, chi2: FloatArray) -> IntArray:
    """Return the tags that the upright model does not explain, which are candidates for `find_tilted`."""
    count, mean = _mean_chi2(tag, chi2)
    dof = UPRIGHT_DOF * np.maximum(count, 1)
    limit = np.maximum(_TILTED_FACTOR, chdtri(dof, FALSE_ALARM) / dof)
    return np.flatnonzero((count > 0) & (mean > limit))


def find_tilted(tag: IntArray, upright_chi2: FloatArray, general_chi2: FloatArray, is_doubted: BoolArray) -> IntArray:
    """Return those of the doubted tags that a general pose explains far better than the upright model.

    Bad corners do not fit either model, so they alone do not make a tag tilted.
    """
    if not is_doubted.any():
        return np.zeros(0, dtype=np.int64)
    _, upright = _mean_chi2(tag[is_doubted], upright_chi2[is_doubted])
    _, general = _mean_chi2(tag[is_doubted], general_chi2[is_doubted])
    return np.flatnonzero(upright > _TILTED_FACTOR * np.maximum(general, 1.0))


def level_of(chi2: FloatArray) -> float:
    """Return the ratio of the median of squared residuals to the one that the corners' sigma implies."""
    finite = chi2[np.isfinite(chi2)]
    if not len(finite):
        return 1.0
    level = max(float(np.median(finite)) / _MEDIAN_CHI2, _LEAST_LEVEL)
    return level if len(finite) >= _OBSERVATIONS_FOR_LEVEL else max(1.0, level)


def _mean_chi2(tag: IntArray, chi2: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return (T,) numbers of observations of each tag, and (T,) means of their capped chi2 per degree of freedom."""
    capped = np.where(np.isfinite(chi2), np.minimum(chi2, _MOST_CHI2), _MOST_CHI2)
    count = np.bincount(tag)
    return count, np.bincount(tag, capped) / (UPRIGHT_DOF * np.maximum(count, 1))
