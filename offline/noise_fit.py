"""The noise parameters, fitted to what the local maps leave over, all runs together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from calib.noise import NoiseParameters
from offline.graph import build_graph
from offline.local_map import LocalMap
from offline.solver import solve
from offline.variance_components import Components, FittedVariances, Part, fit_variances

# What a sigma needs is counts, and they need not be all: 1 % of a sigma comes from some 5,000 residuals.
_MAX_KEYFRAMES: Final = 20_000
_QUANTILE: Final = float(ndtri(0.995))
# No wheel and no detector is so many times better than the defaults: smaller residuals are made up, or too few.
_BEST: Final = 20.0


@dataclass(frozen=True)
class FittedSigma:
    """One noise parameter, as the drives have it.

    Attributes:
        low, high: where it lies with 99 %.
        redundancy: of how many squared residuals of its own it is the mean.
        told: False where the drives say next to nothing of it; then it stands where it began, or where they are more
            content with if that is more, unless they speak against that.
    """

    name: str
    value: float
    low: float
    high: float
    redundancy: float
    told: bool


@dataclass(frozen=True)
class NoiseFit:
    """All noise parameters; those that no measurement depends on stand as they were."""

    noise: NoiseParameters
    sigmas: tuple[FittedSigma, ...]
    converged: bool


def fit_noise(maps: Sequence[LocalMap], noise: NoiseParameters) -> NoiseFit:
    """Fits the noise of all runs at once.

    Args:
        maps: solved under any noise.
        noise: where to begin, and what stays where the drives say nothing.
    """
    names = _names(maps)
    if not names:
        return NoiseFit(noise, (), converged=True)
    share = min(1.0, _MAX_KEYFRAMES / sum(len(each.T_start_base) for each in maps))
    parts = [_part(each, names, share) for each in maps]
    best = NoiseParameters()
    fitted = fit_variances(
        parts,
        np.array([getattr(noise, name) for name in names]),
        least=np.array([getattr(best, name) / _BEST for name in names]),
    )
    values = dict(zip(names, fitted.sigma.tolist(), strict=True))
    return NoiseFit(noise.model_copy(update=values), _sigmas(names, fitted), fitted.converged)


def weighed(local_map: LocalMap, noise: NoiseParameters) -> LocalMap:
    """The same map solved again under other noise."""
    chain = local_map.chain.weighed(noise)
    graph = build_graph([chain])
    return replace(local_map, chain=chain, graph=graph, solution=solve(graph.problem, local_map.solution.state))


def _names(maps: Sequence[LocalMap]) -> tuple[str, ...]:
    """Parameters that some measurement depends on."""
    found = set()
    for each in maps:
        for parts in (each.chain.odometry.parts, each.chain.readings.parts):
            found |= {name for name, unit in zip(parts.names, parts.unit, strict=True) if unit.any()}
    return tuple(name for name in NoiseParameters.model_fields if name in found)


def _part(local_map: LocalMap, names: tuple[str, ...], share: float) -> Part:
    """The first share of a run."""
    chain, state = local_map.chain, local_map.solution.state
    graph, start = local_map.graph, state
    if share < 1.0:
        n_keyframes = max(2, int(share * len(chain.stamps_ns)))
        chain = chain.prefix(n_keyframes)
        graph = build_graph([chain])
        start = graph.start(state.poses[:n_keyframes], local_map.tags_m, local_map.calibration)
    odometry, readings = chain.odometry.parts, chain.readings.parts
    components = Components(odometry.of(names), odometry.rest, readings.of(names), readings.rest)
    return Part(graph.problem, start, components)


def _sigmas(names: Sequence[str], fitted: FittedVariances) -> tuple[FittedSigma, ...]:
    low, high = fitted.interval(_QUANTILE)
    return tuple(
        FittedSigma(
            name=name,
            value=float(fitted.sigma[i]),
            low=float(low[i]),
            high=float(high[i]),
            redundancy=float(fitted.redundancy[i]),
            told=bool(fitted.told[i]),
        )
        for i, name in enumerate(names)
    )
