"""Under which noise the runs of one map are solved together: what they tell themselves, where they may be believed.

One set of sigmas serves all runs: names, `--noise` and map.json have one, and robots of one make differ less in their
wheels than a single drive can tell. It is fitted to the runs whose readings fit together. A run that contradicts itself
says nothing of noise, and is believed no more than before, nor more than the others: of each sigma it gets the larger.

A detector's bias repeats from picture to picture. One by one such readings look good, so what neighbouring readings of
a tag share is fitted too (`local_map.correlated_errors`), and a reading that has many neighbours counts for less.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.local_map import LocalMap, SharedErrors, fit_shared_errors
from groundsbot.offline.maps import NOT_NEEDED, FittedNoise, FittedParameter
from groundsbot.offline.measurements import ODOMETRY_NOISE, Chain, least_shared, least_shared_by_corners
from groundsbot.offline.noise.fit import FittedPart, FittedSigma, fit_noise
from groundsbot.offline.sam import State, solve, whitening

_NO_RUN: Final = "no run has tag readings that fit together"
_NOT_APART: Final = "too few readings tell how much of their errors they share"
# Over so much of the way readings of a tag are taken to share an error; as in `local_map.goodness_of_fit`.
_SHARED_OVER_M: Final = 2.5
# Cells that tell what is shared, as many as leave a variance uncertain by a half.
_LEAST_CELLS: Final = 8.0


class WeighedMaps(NamedTuple):
    """Local maps under the noise that is used from here on, and where that comes from."""

    maps: list[LocalMap]
    noise: NoiseParameters
    fitted: FittedNoise


def fit_and_weigh(maps: Sequence[LocalMap], prior: NoiseParameters) -> WeighedMaps:
    """Fits the noise and solves each map again under it.

    Args:
        maps: solved under the prior.
        prior: what stays where the runs tell nothing.
    """
    sound = [each for each in maps if _is_sound(each)]
    fit = fit_noise(sound, prior)
    found, noise = {each.name: each for each in fit.sigmas}, fit.noise
    shared = np.zeros(2)
    if noise != prior:
        shared, is_told = _shared(fit.parts)
        if not is_told:
            found = {name: _at_least(each, getattr(prior, name)) for name, each in found.items()}
            noise = noise.model_copy(update={name: each.value for name, each in found.items()})
    kept = NOT_NEEDED if sound else _NO_RUN
    parameters = (
        _parameter(found.get(name) or FittedSigma(name, getattr(prior, name), 0.0, 0.0, 0.0, kept))
        for name in NoiseParameters.model_fields
    )
    doubted = _larger(prior, noise)
    solved = {each.chain.name: each.solution.state for each in fit.parts if each.is_whole}
    return WeighedMaps(
        [
            _under(each, noise if each.goodness.fits else doubted, shared, prior, solved.get(each.chain.name))
            for each in maps
        ],
        noise,
        FittedNoise(
            tuple(parameters),
            shared_range=float(shared[0]),
            shared_bearing=float(shared[1]),
            runs=tuple(each.chain.name for each in sound),
            contradicting=tuple(each.chain.name for each in maps if not each.goodness.fits),
        ),
    )


def weighed_as(maps: Sequence[LocalMap], noise: NoiseParameters, fitted: FittedNoise | None) -> list[LocalMap]:
    """Maps solved under the noise of a map that is kept, with what readings share as it was found there."""
    shared = np.zeros(2) if fitted is None else np.array([fitted.shared_range, fitted.shared_bearing])
    # What the windows leave over is still a multiple of the same noise.
    return [replace(_under(each, noise, shared, noise), goodness=each.goodness) for each in maps]


def _is_sound(local_map: LocalMap) -> bool:
    """Whether what a map leaves over is noise; where its solve did not come to its end, nobody knows."""
    return len(local_map.chain.tags) > 0 and local_map.goodness.fits and local_map.solution.converged


def _shared(parts: Sequence[FittedPart]) -> tuple[FloatArray, bool]:
    """(2,) variance that readings of a tag share within a cell, as a multiple of their own; and whether enough tell."""
    read = [each for each in parts if len(each.chain.readings)]  # the beginning of a run may have none
    if not read:
        return np.zeros(2), False
    errors: list[SharedErrors] = [fit_shared_errors(each.solution, _cells(each.chain)) for each in read]
    weight = np.array([each.shared_redundancy for each in errors])
    shared = (weight * np.array([each.shared for each in errors])).sum(axis=0) / weight.sum(axis=0)
    return shared, bool(weight.sum(axis=0)[0] >= _LEAST_CELLS)


def _cells(chain: Chain) -> IntArray:
    """(M,) of each reading: a number for each tag in each part of the way, from 0 without gaps."""
    along_m = chain.along_m[chain.readings.keyframe]
    part = (along_m / _SHARED_OVER_M).astype(np.int64)
    _, cell = np.unique(part * len(chain.tags) + chain.readings.tag, return_inverse=True)
    return np.asarray(cell, dtype=np.int64)


def in_cell(chain: Chain) -> IntArray:
    """(M,) how many readings are in the cell of each."""
    cell = _cells(chain)
    return np.asarray(np.bincount(cell)[cell])


def spread_of_corners(chain: Chain, n_in_cell: IntArray, sigma_corner_px: float, shared: float = 0.0) -> FloatArray:
    """(M,) how many times their sigma corners count with, for what neighbouring readings share.

    Args:
        chain: with one reading at least.
        n_in_cell: (M,) as of `in_cell`.
        sigma_corner_px: of the corners' noise.
        shared: variance that readings were found to share, as a multiple of their own.
    """
    at_least = np.maximum(shared, least_shared_by_corners(chain.readings, sigma_corner_px))
    return np.asarray(np.sqrt(1.0 + n_in_cell * at_least))


def _under(
    local_map: LocalMap, noise: NoiseParameters, shared: FloatArray, prior: NoiseParameters, near: State | None = None
) -> LocalMap:
    """The map solved under other noise and with readings that share errors; the fit may have ended near that."""
    if noise == prior and not shared.any() and not local_map.chain.readings.corner_bias_px.any():
        return local_map
    chain = local_map.chain.weighed(noise)
    if len(chain.readings):
        n_in_cell = in_cell(chain)
        sigmas = np.sqrt(1.0 + n_in_cell[:, None] * np.maximum(shared, least_shared(chain.readings)))
        of_corners = spread_of_corners(chain, n_in_cell, noise.sigma_corner_px, float(shared.max()))
        chain = replace(chain, readings=chain.readings.spread(sigmas, of_corners))
    weights = whitening(chain.odometry.covariance), whitening(chain.readings.covariance)
    graph = replace(local_map.graph, problem=local_map.graph.problem.reweighed(*weights), chains=(chain,))
    goodness = local_map.goodness
    if goodness.fits:  # how many times the prior its noise is has been fitted, and is now in the sigmas
        goodness = replace(goodness, odometry_factor=1.0, reading_factor=1.0)
    solution = solve(graph.problem, near or local_map.solution.state)
    graph.problem.arrowhead.without_scratch()
    return replace(local_map, chain=chain, graph=graph, solution=solution, goodness=goodness)


def _at_least(sigma: FittedSigma, prior: float) -> FittedSigma:
    """A sigma of readings of which nobody knows what they share is believed where it is the larger one only."""
    if sigma.name in ODOMETRY_NOISE or sigma.kept or sigma.value >= prior:
        return sigma
    return replace(sigma, value=prior, kept=_NOT_APART)


def _larger(a: NoiseParameters, b: NoiseParameters) -> NoiseParameters:
    return NoiseParameters(**{name: max(getattr(a, name), getattr(b, name)) for name in NoiseParameters.model_fields})


def _parameter(sigma: FittedSigma) -> FittedParameter:
    low, high = (None, None) if sigma.kept else (sigma.low, sigma.high)
    return FittedParameter(sigma.name, sigma.value, low, high, sigma.redundancy, sigma.kept)
