"""Choice of the noise of all runs of a map, and solves of their local maps under it.

All runs have one set of sigmas, as do `--noise` and map.json. Robots of one make differ less in their wheels than a
single drive determines. The sigmas are fitted to runs that fit, and to runs with far more noise than given, whose fit
is tested afterwards under their fitted noise. A run that contradicts itself is not used for the fit, and gets the
larger of prior and fitted value of each sigma. Errors that neighbouring observations share are fitted too
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
_SHARED_IS_UNDETERMINED: Final = "too few observations determine how much of their errors they share"
# Least number of cells that determine the shared errors; the relative standard deviation of their variance is then 1/2.
_LEAST_CELLS: Final = 4.0
_SHARED: Final = ("shared_range", "shared_bearing", "pass_range", "pass_bearing")


class NoiseOfMaps(NamedTuple):
    """The noise of local maps and its fit, and what it takes to solve them under it.

    Attributes:
        noise: noise of the maps that fit, or that are noisy.
        fitted: its fit.
        shared: (2, 2) variances of the errors that observations share.
        prior: noise under which the maps were solved so far.
    """

    noise: NoiseParameters
    fitted: FittedNoise
    shared: FloatArray
    prior: NoiseParameters

    def solve(self, local_map: LocalMap) -> LocalMap:
        """Return a map solved again under the noise."""
        is_used = local_map.goodness.fits or local_map.is_noisy
        noise = self.noise if is_used else _larger(self.prior, self.noise)
        return _solve_under(local_map, noise, self.shared, self.prior)


def fit_noise_of(maps: Sequence[LocalMap], prior: NoiseParameters, workers: Workers | None = None) -> NoiseOfMaps:
    """Fit the noise of all maps together.

    Args:
        maps: solved under the prior.
        prior: value of sigmas that the runs do not determine.
        workers: processes that share the fit; None: this process.
    """
    used = [each for each in maps if _is_usable(each)]
    fit = fit_noise(used, prior, _inflate_prior(used, prior), workers)
    found, noise = {each.name: each for each in fit.sigmas}, fit.noise
    shared = fit.shared if noise != prior else np.zeros((2, 2))
    if noise != prior and fit.n_groups[0, 0] < _LEAST_CELLS:
        found = {name: _at_least(each, getattr(prior, name)) for name, each in found.items()}
        noise = noise.model_copy(update={name: each.value for name, each in found.items()})
    kept = NOT_NEEDED if used else _NO_RUN
    parameters = (
        _parameter(found.get(name) or FittedSigma(name, getattr(prior, name), 0.0, 0.0, 0.0, kept))
        for name in NoiseParameters.model_fields
    )
    fitted = FittedNoise(
        tuple(parameters),
        **dict(zip(_SHARED, shared.reshape(-1).tolist(), strict=True)),
        runs=tuple(each.segment.name for each in used),
        contradicting=tuple(each.segment.name for each in maps if not (each.goodness.fits or each.is_noisy)),
    )
    return NoiseOfMaps(noise, fitted, shared, prior)


def with_noise_of_map(maps: Sequence[LocalMap], noise: NoiseParameters, fitted: FittedNoise | None) -> list[LocalMap]:
    """Solve maps under the noise of a finished map, with the shared errors of observations that were fitted there.

    Args:
        maps: solved under `noise`, with independent observations.
        noise: noise of the finished map.
        fitted: its fit; None: no shared errors.
    """
    shared = np.zeros((2, 2))
    if fitted is not None:
        shared = np.array([getattr(fitted, name) for name in _SHARED]).reshape(2, 2)
    # The noise of the windows still refers to the same sigmas.
    return [replace(_solve_under(each, noise, shared, noise), goodness=each.goodness) for each in maps]


def _inflate_prior(maps: Sequence[LocalMap], prior: NoiseParameters) -> NoiseParameters:
    """Return initial values: the prior, with odometry noise as large as in the windows of noisy maps.

    A fit that starts from sigmas far too small has no information.
    """
    factor = max([1.0, *(each.goodness.odometry_factor for each in maps if each.is_noisy)])
    return prior.model_copy(update={name: factor * getattr(prior, name) for name in ODOMETRY_NOISE})


def _is_usable(local_map: LocalMap) -> bool:
    """Return whether the residuals of a map are noise: it fits and its solve converged, or its noise is unknown.

    The fit of a map with unknown noise is tested later, under its fitted noise.
    """
    fits = local_map.is_noisy or (local_map.goodness.fits and local_map.solution.converged)
    return len(local_map.segment.tags) > 0 and fits


def _solve_under(local_map: LocalMap, noise: NoiseParameters, shared: FloatArray, prior: NoiseParameters) -> LocalMap:
    """Solve a map under other noise and with variances of shared errors (2, 2)."""
    if noise == prior and not shared.any() and not local_map.segment.observations.corner_bias_px.any():
        return local_map
    segment = with_shared_errors(local_map.segment.with_noise(noise), shared, noise.sigma_corner_px)
    weights = whitening(segment.odometry.covariance), whitening(segment.observations.covariance)
    graph = replace(local_map.graph, problem=local_map.graph.problem.reweigh(*weights), segments=(segment,))
    goodness = local_map.goodness
    if goodness.fits:  # the fitted sigmas now include the factors of its windows
        goodness = replace(goodness, odometry_factor=1.0, observation_factor=1.0)
    solution = solve(graph.problem, local_map.solution.state, local_map.cost_tolerance)
    unfiltered = local_map.unfiltered
    if unfiltered is not None:
        unfiltered = with_shared_errors(unfiltered.with_noise(noise), shared, noise.sigma_corner_px)
    found = replace(
        local_map, segment=segment, graph=graph, solution=solution, goodness=goodness, unfiltered=unfiltered
    )
    return found.without_systems()


def _at_least(sigma: FittedSigma, prior: float) -> FittedSigma:
    """Return a sigma of observations, at least the prior: their shared errors are undetermined."""
    if sigma.name in ODOMETRY_NOISE or sigma.kept or sigma.value >= prior:
        return sigma
    return replace(sigma, value=prior, kept=_SHARED_IS_UNDETERMINED)


def _larger(a: NoiseParameters, b: NoiseParameters) -> NoiseParameters:
    return NoiseParameters(**{name: max(getattr(a, name), getattr(b, name)) for name in NoiseParameters.model_fields})


def _parameter(sigma: FittedSigma) -> FittedParameter:
    low, high = (None, None) if sigma.kept else (sigma.low, sigma.high)
    return FittedParameter(sigma.name, sigma.value, low, high, sigma.redundancy, sigma.kept)
