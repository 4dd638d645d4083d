"""The noise parameters, fitted to what the local maps leave over, all runs together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from groundsbot.calib.foundation import FloatArray, IntArray
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
from groundsbot.offline.noise.likelihood import Components, Part
from groundsbot.offline.noise.shared_errors import lasting_errors, lasting_root
from groundsbot.offline.noise.variance_components import LEAST_REDUNDANCY, FittedVariances, fit_variances
from groundsbot.offline.sam import build_graph

# What a sigma needs is counts, and they need not be all: 1 % of a sigma comes from some 5,000 residuals. Keyframes are
# spread over the whole of long runs, since what observations share shows where tags are met again.
_MAX_KEYFRAMES: Final = 6_000
_LEAST_SHARE: Final = 0.25  # of the spacings of `coarse_keyframes`
_NEXT_SHARE: Final = 1.4
_QUANTILE: Final = float(ndtri(0.995))
# No wheel and no detector is so many times better than the defaults: smaller residuals are made up.
PLAUSIBLE: Final = 20.0
_NEGLIGIBLE: Final = "the other noise of observations explains their errors without it"
_LEAST: Final = (1.0 + 1e-6) / PLAUSIBLE  # where the search stops, with its rounding


@dataclass(frozen=True)
class FittedSigma:
    """One noise parameter, as the drives have it.

    Attributes:
        value: fitted, or where the fit began.
        low, high: where it lies with 99 %, as far as the drives tell.
        redundancy: of how many squared residuals of its own it is the mean.
        kept: why it stands where it began; empty where it was fitted.
    """

    name: str
    value: float
    low: float
    high: float
    redundancy: float
    kept: str = ""


@dataclass(frozen=True)
class NoiseFit:
    """All noise parameters.

    Attributes:
        noise: fitted.
        sigmas: those that some measurement depends on.
        shared: (2, 2) variances of errors that the observations of a tag share within a cell (row 0) and within a pass
            (row 1), in range and bearing, as multiples of the variance that the default noise gives them.
        n_groups: (2, 2) of how many cells and passes tell of them.
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
    """Fits the noise of all runs at once, whatever it comes out at.

    What the drives tell too little of stays where it began, or where they are more content with if that is more; what
    comes out smaller than any robot's stays, and the others are fitted without it.

    Args:
        maps: solved under any noise.
        noise: what stays where the drives say nothing.
        start: where to begin; there where None.
        workers: share out the maps; None: this process.
    """
    workers = workers or Workers()
    maps = sorted(maps, key=lambda each: each.segment.name)  # sums are rounded alike whatever the order of the logs
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
            told = {each.name: each for each in found}
            values = dict(zip(free, fitted.sigma.tolist(), strict=True))
            return NoiseFit(noise.model_copy(update=values), _in_order(told | kept), fitted.shared, fitted.n_groups)
        kept |= {name: _keep_prior(each, noise) for name, each in small.items()}
        free = tuple(name for name in free if name not in small)
    return NoiseFit(noise, _in_order(kept), np.zeros((2, 2)), np.zeros((2, 2)))


def _other_noise_of_observations(found: Sequence[FittedSigma], small: Mapping[str, FittedSigma]) -> bool:
    """Return whether some other sigma explains the errors of observations, so that the small ones have no part in them.

    Their default in place of the small value would be far more than the residuals show, and the fit would explain
    everything by it.
    """
    others = [each for each in found if each.name not in ODOMETRY_NOISE and each.name not in small]
    return any(not each.kept for each in others)


def _times_default(sigma: FittedSigma) -> float:
    default: float = getattr(NoiseParameters(), sigma.name)
    return sigma.value / default


def _keep_prior(sigma: FittedSigma, noise: NoiseParameters) -> FittedSigma:
    why = f"it came out at {_times_default(sigma):.3g} times the default, which no robot has"
    return replace(sigma, value=getattr(noise, sigma.name), kept=why)


def _names(maps: Sequence[LocalMap]) -> tuple[str, ...]:
    """Parameters that some measurement depends on."""
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
    """All of each run, at so few keyframes that all together have no more than is looked at."""
    segments = [each.segment for each in maps]
    n_all = sum(len(segment.stamps_ns) for segment in segments)
    if n_all <= _MAX_KEYFRAMES:
        return segments
    share = _LEAST_SHARE
    keyframes = [coarse_keyframes(segment, share) for segment in segments]
    while sum(map(len, keyframes)) > _MAX_KEYFRAMES:
        share *= _NEXT_SHARE
        keyframes = [coarse_keyframes(segment, share) for segment in segments]
    return [coarsen(*each) for each in zip(segments, keyframes, strict=True)]


def _part(local_map: LocalMap, segment: Segment, noise: NoiseParameters, names: tuple[str, ...]) -> Part:
    """Of a map, the segment that is all of its own or some keyframes of it."""
    state = local_map.solution.state
    graph, start = local_map.graph, state
    if segment is not local_map.segment:
        graph = build_graph([segment])
        at = np.searchsorted(local_map.segment.stamps_ns, segment.stamps_ns)
        start = graph.start(state.poses[at], local_map.tags_m, local_map.calibration)
    odometry, observations = segment.odometry.parts, segment.observations.parts
    components = Components(
        odometry.of(names),
        _rest(odometry, noise, names),
        observations.of(names),
        _rest(observations, noise, names),
        lasting_errors(segment),
        lasting_root(segment),
        *_of_stamps(segment, names),
    )
    return Part(graph.problem, start, components, segment.name)


def _of_stamps(segment: Segment, names: tuple[str, ...]) -> tuple[int, FloatArray, IntArray] | tuple[None, None, None]:
    """Which variance is that of stamps, observations' change in a second, and the picture of each; or nothing of it."""
    if STAMP_NOISE not in names or not len(segment.observations):
        return None, None, None
    _, picture = np.unique(segment.observations.keyframe, return_inverse=True)
    by_time = segment.observations.by_camera[..., CAMERA_PARAMETERS.index(TIME_OFFSET)]
    return names.index(STAMP_NOISE), by_time, np.asarray(picture, dtype=np.int64)


def _rest(parts: CovarianceParts, noise: NoiseParameters, names: tuple[str, ...]) -> FloatArray:
    """(M, n, n) what does not depend on the parameters looked for."""
    return parts.under(noise) - sum(
        (getattr(noise, name) ** 2 * unit for name, unit in zip(names, parts.of(names), strict=True)),
        start=np.zeros_like(parts.rest),
    )


def _sigmas(names: Sequence[str], fitted: FittedVariances) -> list[FittedSigma]:
    low, high = fitted.interval(_QUANTILE)
    found = []
    for i, name in enumerate(names):
        kept = ""
        if not fitted.told[i]:
            kept = (
                f"the drives tell too little of it (redundancy {fitted.redundancy[i]:.1f}, {LEAST_REDUNDANCY:g} needed)"
            )
        found.append(
            FittedSigma(name, float(fitted.sigma[i]), float(low[i]), float(high[i]), float(fitted.redundancy[i]), kept)
        )
    return found
