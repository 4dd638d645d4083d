"""Fit of the noise parameters to the residuals of all local maps together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.robot import CAMERA_PARAMETERS, TIME_OFFSET, NoiseParameters
from groundsbot.offline.foundation import Workers
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import (
    ODOMETRY_NOISE,
    STAMP_NOISE,
    CovarianceParts,
    Segment,
    coarse_keyframes,
    coarsen,
)
from groundsbot.offline.noise.components import Components
from groundsbot.offline.noise.likelihood import Part
from groundsbot.offline.noise.shared_errors import lasting_errors, lasting_root
from groundsbot.offline.noise.variance_components import LEAST_REDUNDANCY, FittedVariances, fit_variances
from groundsbot.offline.sam import build_graph

# About 5,000 residuals determine a sigma to 1 %, so not all keyframes are needed. They are spread over the whole of
# long runs, since shared errors of observations show where tags are observed again. Of many drives more are taken:
# errors of observations that are farther apart than the correlation length of shared ones look independent, whichever
# of both they are.
_MAX_KEYFRAMES: Final = 6_000
_LEAST_SHARE: Final = 0.25  # of the spacings of `coarse_keyframes`
_NEXT_SHARE: Final = 1.4
_MOST_SHARE: Final = 2.0  # half a metre between keyframes with observations, twice the correlation length
_QUANTILE: Final = float(ndtri(0.995))
# Largest plausible ratio of a default to the fitted sigma; with smaller residuals data are taken for synthetic.
PLAUSIBLE: Final = 20.0
_NEGLIGIBLE: Final = "the other noise of observations explains their errors without it"
_LEAST: Final = (1.0 + 1e-6) / PLAUSIBLE  # lower bound of the search, with its rounding


@dataclass(frozen=True)
class FittedSigma:
    """One noise parameter by the residuals of the drives.

    Attributes:
        value: fitted, or the prior value.
        low, high: bounds of its 99 % interval.
        redundancy: number of squared residuals whose mean is equally uncertain.
        kept: reason why it was not fitted; empty if it was.
    """

    name: str
    value: float
    low: float
    high: float
    redundancy: float
    kept: str = ""


@dataclass(frozen=True)
class NoiseFit:
    """Fit of all noise parameters.

    Attributes:
        noise: the parameters after the fit.
        sigmas: those that some measurement depends on.
        shared: (2, 2) variances of errors that the observations of a tag share within a cell (row 0) and within a track
            (row 1), in range and bearing, as multiples of the variance by the default noise.
        n_groups: (2, 2) effective number of cells and tracks that determine these.
    """

    noise: NoiseParameters
    sigmas: tuple[FittedSigma, ...]
    shared: FloatArray
    n_groups: FloatArray


def fit_noise(
    maps: Sequence[LocalMap],
    noise: NoiseParameters,
    start: NoiseParameters | None = None,
    workers: Workers | None = None,
) -> NoiseFit:
    """Fit the noise of all runs together.

    A sigma that the residuals do not determine keeps its prior value, or gets the fitted one if that is larger. A sigma
    that is fitted at an implausibly small value keeps its prior value, and the others are fitted without it.

    Args:
        maps: solved under any noise.
        noise: the prior.
        start: initial values; None: the prior.
        workers: processes that share the maps; None: this process.
    """
    workers = workers or Workers()
    maps = sorted(maps, key=lambda each: each.segment.name)  # rounding then does not depend on the order of the logs
    free = _names(maps)
    kept: dict[str, FittedSigma] = {}
    while free:
        fitted = _fit(maps, noise, start or noise, free, workers)
        found = _sigmas(free, fitted)
        small = {each.name: each for each in found if _times_default(each) <= _LEAST and not each.kept}
        if _other_noise_of_observations(found, small):
            negligible = small.keys() - ODOMETRY_NOISE
            found = [replace(each, kept=_NEGLIGIBLE) if each.name in negligible else each for each in found]
            small = {name: each for name, each in small.items() if name not in negligible}
        if not small:
            sigmas = {each.name: each for each in found} | kept
            values = dict(zip(free, fitted.sigma.tolist(), strict=True))
            return NoiseFit(noise.model_copy(update=values), _in_order(sigmas), fitted.shared, fitted.n_groups)
        kept |= {name: _keep_prior(each, noise) for name, each in small.items()}
        free = tuple(name for name in free if name not in small)
    return NoiseFit(noise, _in_order(kept), np.zeros((2, 2)), np.zeros((2, 2)))


def _other_noise_of_observations(found: Sequence[FittedSigma], small: Mapping[str, FittedSigma]) -> bool:
    """Return whether another sigma was fitted that explains the errors of observations without the small ones.

    The small ones then keep their small values: with their defaults instead, which the residuals contradict, the fit
    would attribute all errors to them.
    """
    others = [each for each in found if each.name not in ODOMETRY_NOISE and each.name not in small]
    return any(not each.kept for each in others)


def _times_default(sigma: FittedSigma) -> float:
    default: float = getattr(NoiseParameters(), sigma.name)
    return sigma.value / default


def _keep_prior(sigma: FittedSigma, noise: NoiseParameters) -> FittedSigma:
    reason = f"the fit gave {_times_default(sigma):.3g} times the default, which is implausible"
    return replace(sigma, value=getattr(noise, sigma.name), kept=reason)


def _names(maps: Sequence[LocalMap]) -> tuple[str, ...]:
    """Return the names of the parameters that some measurement depends on."""
    found = set()
    for each in maps:
        for parts in (each.segment.odometry.parts, each.segment.observations.parts):
            found |= {name for name, unit in zip(parts.names, parts.unit, strict=True) if unit.any()}
    return tuple(name for name in NoiseParameters.model_fields if name in found)


def _in_order(sigmas: dict[str, FittedSigma]) -> tuple[FittedSigma, ...]:
    return tuple(sigmas[name] for name in NoiseParameters.model_fields if name in sigmas)


def _fit(
    maps: Sequence[LocalMap],
    noise: NoiseParameters,
    start: NoiseParameters,
    names: tuple[str, ...],
    workers: Workers,
) -> FittedVariances:
    default = NoiseParameters()
    return fit_variances(
        [_part(each, segment, noise, names) for each, segment in zip(maps, _thin(maps), strict=True)],
        np.array([getattr(noise, name) for name in names]),
        least=np.array([getattr(default, name) / PLAUSIBLE for name in names]),
        start=np.array([getattr(start, name) for name in names]),
        workers=workers,
    )


def _thin(maps: Sequence[LocalMap]) -> list[Segment]:
    """Return the segments; coarsened if they have more than `_MAX_KEYFRAMES` keyframes together."""
    segments = [each.segment for each in maps]
    n_all = sum(len(segment.stamps_ns) for segment in segments)
    if n_all <= _MAX_KEYFRAMES:
        return segments
    share = _LEAST_SHARE
    keyframes = [coarse_keyframes(segment, share) for segment in segments]
    while sum(map(len, keyframes)) > _MAX_KEYFRAMES and share < _MOST_SHARE:
        share = min(share * _NEXT_SHARE, _MOST_SHARE)
        keyframes = [coarse_keyframes(segment, share) for segment in segments]
    return [coarsen(*each) for each in zip(segments, keyframes, strict=True)]


def _part(local_map: LocalMap, segment: Segment, noise: NoiseParameters, names: tuple[str, ...]) -> Part:
    """Return the problem and the covariance components of a map, for its segment or the coarsened one."""
    state = local_map.solution.state
    graph, start = local_map.graph, state
    if segment is not local_map.segment:
        graph = build_graph([segment])
        at = np.searchsorted(local_map.segment.stamps_ns, segment.stamps_ns)
        start = graph.start(state.poses[at], local_map.tags_m, local_map.calibration)
    odometry, observations = segment.odometry.parts, segment.observations.parts
    common, common_root = _of_stamps(segment, names)
    _, picture = np.unique(segment.observations.keyframe, return_inverse=True)
    components = Components(
        odometry.of(names),
        _rest(odometry, noise, names),
        observations.of(names),
        _rest(observations, noise, names),
        lasting_errors(segment),
        lasting_root(segment),
        common,
        common_root,
        segment.observations.jitter_root if segment.observations.heading_jitter_rad.any() else None,
        np.asarray(picture, dtype=np.int64),
    )
    return Part(graph.problem, start, components, segment.name)


def _of_stamps(segment: Segment, names: tuple[str, ...]) -> tuple[int, FloatArray] | tuple[None, None]:
    """Return the index of the variance of stamps and the observations' time derivatives (N, 2).

    Both are None if the stamps have no noise, or without observations.
    """
    if STAMP_NOISE not in names or not len(segment.observations):
        return None, None
    return names.index(STAMP_NOISE), segment.observations.by_camera[..., CAMERA_PARAMETERS.index(TIME_OFFSET)]


def _rest(parts: CovarianceParts, noise: NoiseParameters, names: tuple[str, ...]) -> FloatArray:
    """Return the parts (M, n, n) of covariances that do not depend on the parameters `names`."""
    return parts.under(noise) - sum(
        (getattr(noise, name) ** 2 * unit for name, unit in zip(names, parts.of(names), strict=True)),
        start=np.zeros_like(parts.rest),
    )


def _sigmas(names: Sequence[str], fitted: FittedVariances) -> list[FittedSigma]:
    low, high = fitted.interval(_QUANTILE)
    found = []
    for i, name in enumerate(names):
        kept = ""
        if not fitted.is_determined[i]:
            kept = (
                f"the drives do not determine it (redundancy {fitted.redundancy[i]:.1f}, {LEAST_REDUNDANCY:g} needed)"
            )
        found.append(
            FittedSigma(name, float(fitted.sigma[i]), float(low[i]), float(high[i]), float(fitted.redundancy[i]), kept)
        )
    return found
