"""Under which noise the runs of one map are solved together: what they tell themselves, where they may be believed.

One set of sigmas serves all runs: names, `--noise` and map.json have one, and robots of one make differ less in their
wheels than a single drive can tell. It is fitted to the runs whose observations fit together, and to those whose noise
is far from what was told: whether these fit together is asked under the noise that they have.
A run that contradicts itself beside others that do not says nothing of noise, and is believed no more than before, nor
more than the others: of each sigma it gets the larger. What neighbouring observations share is fitted too
(`shared_errors`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.foundation import Workers
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.maps import NOT_NEEDED, FittedNoise, FittedParameter
from groundsbot.offline.measurements import ODOMETRY_NOISE
from groundsbot.offline.noise.fit import FittedSigma, fit_noise
from groundsbot.offline.noise.shared_errors import with_shared_errors
from groundsbot.offline.sam import solve, whitening

_NO_RUN: Final = "no run has tag observations that fit together"
_NOT_APART: Final = "too few observations tell how much of their errors they share"
# Cells that tell what is shared, as many as leave a variance uncertain by a half.
_LEAST_CELLS: Final = 4.0


_SHARED: Final = ("shared_range", "shared_bearing", "pass_range", "pass_bearing")


class WeighedMaps(NamedTuple):
    """Local maps under the noise that is used from here on, and where that comes from."""

    maps: list[LocalMap]
    noise: NoiseParameters
    fitted: FittedNoise


def fit_and_weigh(maps: Sequence[LocalMap], prior: NoiseParameters, workers: Workers | None = None) -> WeighedMaps:
    """Fits the noise and solves each map again under it.

    Args:
        maps: solved under the prior.
        prior: what stays where the runs tell nothing.
        workers: share out the fit; None: this process.
    """
    sound = [each for each in maps if _is_sound(each)]
    fit = fit_noise(sound, prior, _inflate_prior(sound, prior), workers)
    found, noise = {each.name: each for each in fit.sigmas}, fit.noise
    is_told = bool(fit.n_groups[0, 0] >= _LEAST_CELLS)
    shared = fit.shared if noise != prior else np.zeros((2, 2))
    if noise != prior and not is_told:
        found = {name: _at_least(each, getattr(prior, name)) for name, each in found.items()}
        noise = noise.model_copy(update={name: each.value for name, each in found.items()})
    kept = NOT_NEEDED if sound else _NO_RUN
    parameters = (
        _parameter(found.get(name) or FittedSigma(name, getattr(prior, name), 0.0, 0.0, 0.0, kept))
        for name in NoiseParameters.model_fields
    )
    doubted = _larger(prior, noise)
    return WeighedMaps(
        [_under(each, noise if each.goodness.fits or each.is_noisy else doubted, shared, prior) for each in maps],
        noise,
        FittedNoise(
            tuple(parameters),
            **dict(zip(_SHARED, shared.reshape(-1).tolist(), strict=True)),
            runs=tuple(each.segment.name for each in sound),
            contradicting=tuple(each.segment.name for each in maps if not (each.goodness.fits or each.is_noisy)),
        ),
    )


def with_noise_of_map(maps: Sequence[LocalMap], noise: NoiseParameters, fitted: FittedNoise | None) -> list[LocalMap]:
    """Maps solved under the noise of a map that is kept, with what observations share as it was found there."""
    shared = np.zeros((2, 2))
    if fitted is not None:
        shared = np.array([getattr(fitted, name) for name in _SHARED]).reshape(2, 2)
    # What the windows leave over is still a multiple of the same noise.
    return [replace(_under(each, noise, shared, noise), goodness=each.goodness) for each in maps]


def _inflate_prior(maps: Sequence[LocalMap], prior: NoiseParameters) -> NoiseParameters:
    """The prior, wheels as much worse as windows of noisy drives show; from far too small sigmas nothing is told."""
    times = max([1.0, *(each.goodness.odometry_factor for each in maps if each.is_noisy)])
    return prior.model_copy(update={name: times * getattr(prior, name) for name in ODOMETRY_NOISE})


def _is_sound(local_map: LocalMap) -> bool:
    """Whether what a map leaves over is noise; where its solve did not come to its end, nobody knows.

    Of one whose noise is unknown it is all that is known of that; whether it fits is asked afterwards.
    """
    fits = local_map.is_noisy or (local_map.goodness.fits and local_map.solution.converged)
    return len(local_map.segment.tags) > 0 and fits


def _under(local_map: LocalMap, noise: NoiseParameters, shared: FloatArray, prior: NoiseParameters) -> LocalMap:
    """The map solved under other noise and with observations that share errors."""
    if noise == prior and not shared.any() and not local_map.segment.observations.corner_bias_px.any():
        return local_map
    segment = with_shared_errors(local_map.segment.with_noise(noise), shared, noise.sigma_corner_px)
    weights = whitening(segment.odometry.covariance), whitening(segment.observations.covariance)
    graph = replace(local_map.graph, problem=local_map.graph.problem.reweigh(*weights), segments=(segment,))
    goodness = local_map.goodness
    if goodness.fits:  # how many times the prior its noise is has been fitted, and is now in the sigmas
        goodness = replace(goodness, odometry_factor=1.0, observation_factor=1.0)
    solution = solve(graph.problem, local_map.solution.state)
    graph.problem.arrowhead.without_scratch()
    whole = local_map.unfiltered
    if whole is not None:
        whole = with_shared_errors(whole.with_noise(noise), shared, noise.sigma_corner_px)
    return replace(local_map, segment=segment, graph=graph, solution=solution, goodness=goodness, unfiltered=whole)


def _at_least(sigma: FittedSigma, prior: float) -> FittedSigma:
    """A sigma of observations of which nobody knows what they share is believed where it is the larger one only."""
    if sigma.name in ODOMETRY_NOISE or sigma.kept or sigma.value >= prior:
        return sigma
    return replace(sigma, value=prior, kept=_NOT_APART)


def _larger(a: NoiseParameters, b: NoiseParameters) -> NoiseParameters:
    return NoiseParameters(**{name: max(getattr(a, name), getattr(b, name)) for name in NoiseParameters.model_fields})


def _parameter(sigma: FittedSigma) -> FittedParameter:
    low, high = (None, None) if sigma.kept else (sigma.low, sigma.high)
    return FittedParameter(sigma.name, sigma.value, low, high, sigma.redundancy, sigma.kept)
