"""The noise parameters, fitted to what the local maps leave over, all runs together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import Chain, CovarianceParts
from groundsbot.offline.noise.likelihood import Components, Part
from groundsbot.offline.noise.variance_components import LEAST_REDUNDANCY, FittedVariances, fit_variances
from groundsbot.offline.sam import Solution, build_graph

# What a sigma needs is counts, and they need not be all: 1 % of a sigma comes from some 5,000 residuals.
_MAX_KEYFRAMES: Final = 6_000
_QUANTILE: Final = float(ndtri(0.995))
# No wheel and no detector is so many times better or worse than the defaults: smaller residuals are made up, and larger
# ones are no noise.
PLAUSIBLE: Final = 20.0
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
class FittedPart:
    """The beginning of a chain, or all of it, and its solution."""

    chain: Chain
    solution: Solution
    is_whole: bool


@dataclass(frozen=True)
class NoiseFit:
    """All noise parameters.

    Attributes:
        noise: fitted.
        sigmas: those that some measurement depends on.
        parts: of each map what was looked at, as solved under the fitted noise; none where nothing was fitted.
    """

    noise: NoiseParameters
    sigmas: tuple[FittedSigma, ...]
    parts: tuple[FittedPart, ...] = ()


def fit_noise(maps: Sequence[LocalMap], noise: NoiseParameters) -> NoiseFit:
    """Fits the noise of all runs at once.

    What the drives tell too little of stays where it began, or where they are more content with if that is more; what
    comes out smaller than any robot's stays, and the others are fitted without it; all stay if the fit finds no end, or
    one comes out larger than any noise.

    Args:
        maps: solved under any noise.
        noise: where to begin, and what stays where the drives say nothing.
    """
    free = _names(maps)
    kept: dict[str, FittedSigma] = {}
    while free:
        fitted = _fitted(maps, noise, free)
        found = _sigmas(free, fitted)
        why = _no_noise(found) if fitted.converged else "the fit came to no end"
        if why:
            kept |= {each.name: replace(each, value=getattr(noise, each.name), kept=why) for each in found}
            break
        small = {each.name: _left(each, noise) for each in found if _times_default(each) <= _LEAST and not each.kept}
        if not small:
            told = {each.name: each for each in found}
            values = dict(zip(free, fitted.sigma.tolist(), strict=True))
            parts = tuple(
                FittedPart(chain, solution, chain is each.chain)
                for each, chain, solution in zip(maps, _beginnings(maps), fitted.solutions, strict=True)
            )
            return NoiseFit(noise.model_copy(update=values), _in_order(told | kept), parts)
        kept |= small
        free = tuple(name for name in free if name not in small)
    return NoiseFit(noise, _in_order(kept))


def _times_default(sigma: FittedSigma) -> float:
    default: float = getattr(NoiseParameters(), sigma.name)
    return sigma.value / default


def _no_noise(found: Sequence[FittedSigma]) -> str:
    """Why what the drives leave over is no noise; empty if it may be.

    What one sigma cannot explain the others were stretched to as well, so none of them is believed then.
    """
    for each in found:
        if not each.kept and _times_default(each) >= PLAUSIBLE:
            return (
                f"{each.name} came out at {_times_default(each):.3g} times the default: what is left over is no noise"
            )
    return ""


def _left(sigma: FittedSigma, noise: NoiseParameters) -> FittedSigma:
    why = f"it came out at {_times_default(sigma):.3g} times the default, which no robot has"
    return replace(sigma, value=getattr(noise, sigma.name), kept=why)


def _names(maps: Sequence[LocalMap]) -> tuple[str, ...]:
    """Parameters that some measurement depends on."""
    found = set()
    for each in maps:
        for parts in (each.chain.odometry.parts, each.chain.readings.parts):
            found |= {name for name, unit in zip(parts.names, parts.unit, strict=True) if unit.any()}
    return tuple(name for name in NoiseParameters.model_fields if name in found)


def _in_order(sigmas: dict[str, FittedSigma]) -> tuple[FittedSigma, ...]:
    return tuple(sigmas[name] for name in NoiseParameters.model_fields if name in sigmas)


def _fitted(maps: Sequence[LocalMap], noise: NoiseParameters, names: tuple[str, ...]) -> FittedVariances:
    default = NoiseParameters()
    return fit_variances(
        [_part(each, part, noise, names) for each, part in zip(maps, _beginnings(maps), strict=True)],
        np.array([getattr(noise, name) for name in names]),
        least=np.array([getattr(default, name) / PLAUSIBLE for name in names]),
    )


def _beginnings(maps: Sequence[LocalMap]) -> list[Chain]:
    """The same share of each run."""
    share = min(1.0, _MAX_KEYFRAMES / sum(len(each.T_start_base) for each in maps))
    if share == 1.0:
        return [each.chain for each in maps]
    return [each.chain.prefix(max(2, int(share * len(each.chain.stamps_ns)))) for each in maps]


def _part(local_map: LocalMap, chain: Chain, noise: NoiseParameters, names: tuple[str, ...]) -> Part:
    """Of a map, the chain that is all of its own or the beginning of it."""
    state = local_map.solution.state
    graph, start = local_map.graph, state
    if chain is not local_map.chain:
        graph = build_graph([chain])
        start = graph.start(state.poses[: len(chain.stamps_ns)], local_map.tags_m, local_map.calibration)
    odometry, readings = chain.odometry.parts, chain.readings.parts
    components = Components(
        odometry.of(names), _rest(odometry, noise, names), readings.of(names), _rest(readings, noise, names)
    )
    return Part(graph.problem, start, components)


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
