"""Errors that readings of a tag share: within some metres of the way, and within the whole of a pass.

A detector's bias depends on how a tag looks, a sensor's on the range, a clock's on the speed: so an error repeats from
picture to picture, and the mean of m readings is less certain than one reading over sqrt(m). At two levels readings are
taken to err by a part that the level shares: a cell, 2.5 m of the way, and a pass. Their variances are fitted with all
others (`variance_components`); a reading then counts as one of m independent ones that tell as much together.
"""

from dataclasses import replace

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.measurements import Chain, cells_of, least_shared, least_shared_by_corners, passes_of


def shared_levels(chain: Chain) -> tuple[IntArray, ...]:
    """For each level (M,) the group of each reading, from 0 without gaps: cells, then passes."""
    return cells_of(chain), passes_of(chain)


def shared_root(chain: Chain) -> FloatArray:
    """(M, 2, 2) whose columns a shared error of one adds to a reading: in range and bearing, as the default noise is.

    Of readings whose log gives their covariance that is a multiple of their own.
    """
    return np.asarray(np.linalg.cholesky(chain.readings.parts.under(NoiseParameters())))


def in_cell(chain: Chain) -> IntArray:
    """(M,) how many readings are in the cell of each."""
    return _n_in_group(cells_of(chain))


def spread_of_corners(chain: Chain, n_in_cell: IntArray, sigma_corner_px: float) -> FloatArray:
    """(M,) how many times their sigma corners count with, for what refined corners are known to share.

    Args:
        chain: with one reading at least.
        n_in_cell: (M,) as of `in_cell`.
        sigma_corner_px: of the corners' noise.
    """
    return np.asarray(np.sqrt(1.0 + n_in_cell * least_shared_by_corners(chain.readings, sigma_corner_px)))


def counted_for_less(chain: Chain, shared: FloatArray, sigma_corner_px: float) -> Chain:
    """The chain with readings that count for less by what they share.

    Args:
        chain: under its noise, with its readings as independent.
        shared: (2, 2) variances by level and component, as multiples of the squares of `shared_root`.
        sigma_corner_px: of the corners' noise.
    """
    readings = chain.readings
    if not len(readings) or not (shared.any() or readings.corner_bias_px.any()):
        return chain
    back = np.linalg.inv(np.linalg.cholesky(readings.covariance)) @ shared_root(chain)
    times = np.zeros((len(readings), 2))
    for group, both in zip(shared_levels(chain), shared, strict=True):
        times += _n_in_group(group)[:, None] * np.einsum("mij,j->mi", back**2, both)
    n_in_cell = in_cell(chain)
    sigmas = np.sqrt(1.0 + np.maximum(times, n_in_cell[:, None] * least_shared(readings)))
    of_corners = np.maximum(np.sqrt(1.0 + times.max(axis=1)), spread_of_corners(chain, n_in_cell, sigma_corner_px))
    return replace(chain, readings=readings.spread(sigmas, of_corners))


def _n_in_group(group: IntArray) -> IntArray:
    """(M,) how many are in the group of each."""
    return np.asarray(np.bincount(group)[group], dtype=np.int64)
