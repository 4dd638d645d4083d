"""What readings say of the place of a tag in each sighting, all else eliminated: any split is then dense algebra.

Let every sighting have a place of its own. With poses and calibration eliminated the cost is a quadratic form
q(p) = p' L p / 2 + z' p in these places p, taken from where a solve has them, and to take some of them for one is to
put them equal. So one linearisation tells the cost of every split of every tag: the score test (Rao, 1948) with the
exact joint information of all readings, for all hypotheses at once.

A tag is moved by more than a lean of its board or the remains of a lens shift it: each sighting may be off by a
centimetre, which the form carries: (L^-1 + s^2)^-1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import linalg, sparse

from calib.arrays import BoolArray, FloatArray, IntArray
from offline.factors import Columns, State, stacked
from offline.goodness import Goodness
from offline.graph import Graph
from offline.joint_fit import UNMODELLED_SIGMA_M
from offline.robust import losses_and_weights
from offline.solver import DEFAULT_LOSSES, PLAIN_SQUARES, Problem, Solution
from offline.suspects_sightings import Sightings

_WEIGHINGS: Final = 5
_MOVED_IN_SIGHT: Final = 1e-4


@dataclass(frozen=True)
class Evidence:
    """The cost as a function of the places of K of the sightings: those of tags that were sighted more than once.

    Attributes:
        which: (K,) indices of the sightings.
        information: (2 K, 2 K) L, and score: (2 K,) z, in squared sigmas by metres from `places_m`.
        places_m: (K, 2) the linearisation point.
    """

    which: IntArray
    information: FloatArray
    score: FloatArray
    places_m: FloatArray


def noise_scales(goodness: Sequence[Goodness]) -> FloatArray:
    """(C, 2) how many times larger than told the noise of each chain's wheels and readings is, 1 at least.

    By what the windows of each chain leave over, which no tag that was moved between them raises; where windows do not
    join within that, something that is in no covariance bends the chain, and the covariances say too little.
    """
    rows = []
    for each in goodness:
        bent = 1.0 if each.fits else float(np.sqrt(each.chi_square / max(each.expected, 1)))
        rows.append([bent * max(1.0, each.odometry_factor), bent * max(1.0, each.reading_factor)])
    return np.array(rows).reshape(-1, 2)


def gathered(
    graph: Graph,
    state: State,
    sightings: Sightings,
    scales: FloatArray,
    unmodelled_sigma_m: float = UNMODELLED_SIGMA_M,
    *,
    weighed: bool = True,
) -> Evidence:
    """Linearises all factors at a state and eliminates all but the sightings' places.

    Args:
        graph: of the chains that the sightings are of.
        state: near an optimum.
        sightings: S of them.
        scales: (C, 2) of each chain's noise, see `noise_scales`.
        unmodelled_sigma_m: of each coordinate of a sighting, beyond what the covariances say.
        weighed: whether readings count by how well they fit the others of their sighting, or all alike.
    """
    held = _sighted_again(sightings)
    if not held.any():
        none = np.zeros((0, 2))
        return Evidence(np.zeros(0, dtype=np.int64), np.zeros((0, 0)), none.reshape(-1), none)
    problem = _scaled(graph, scales)
    if weighed:
        problem = _weighed(problem, state, sightings)
    of_reading = sightings.of_reading
    which = np.flatnonzero(held[sightings.id])
    place_of = np.full(len(sightings), -1, dtype=np.int64)
    place_of[which] = np.arange(len(which))
    tag_held = np.zeros(len(graph.tags), dtype=np.bool_)
    tag_held[problem.readings.tag] = place_of[of_reading] >= 0
    tag_of_sighting = np.zeros(len(sightings), dtype=np.int64)
    tag_of_sighting[of_reading] = problem.readings.tag
    places_m = state.tags[tag_of_sighting[which]]
    eliminated = replace(problem, columns=_without_tags(problem.columns, tag_held))
    _, distances = problem.measured.linearise(state, eliminated.columns)
    readings = problem.readings.linearise(state, eliminated.columns)
    by_place = readings._replace(blocks=((_columns_of(place_of[of_reading]), readings.blocks[1][1]),))
    # What was measured to a tag was measured to where it was first.
    first_place = np.full(len(graph.tags), -1, dtype=np.int64)
    first_place[tag_of_sighting[which[::-1]]] = place_of[which[::-1]]
    to_places = replace(
        problem.columns, poses=np.full_like(problem.columns.poses, -1), tags=_columns_of(first_place), n=2 * len(which)
    )
    _, to_place = problem.measured.linearise(state, to_places)
    by_others, _ = stacked((readings, distances), eliminated.columns.n)
    by_places, read = stacked((by_place, to_place), 2 * len(which))
    coupling = sparse.csc_array(by_others.T @ by_places)
    solution = Solution(state, (0.0,), "", converged=True, problem=eliminated, losses=PLAIN_SQUARES)
    factorisation = solution.factorisation
    others_step = factorisation.solve_in_order(factorisation.system.gradient)[eliminated.arrowhead.tangent]
    information = factorisation.quadratic_form(coupling)
    np.subtract((by_places.T @ by_places).toarray(), information, out=information)
    score = by_places.T @ read - coupling.T @ others_step
    return Evidence(which, *_with_slack(information, score, unmodelled_sigma_m), places_m)


def _columns_of(place: IntArray) -> IntArray:
    """(n, 2) columns of places (n,), -1 where there is none."""
    columns: IntArray = np.where(place[:, None] >= 0, 2 * place[:, None] + np.arange(2), -1)
    return columns


def _sighted_again(sightings: Sightings) -> BoolArray:
    """(N,) which ids were sighted more than once."""
    return np.asarray(np.bincount(sightings.id, minlength=len(sightings.ids)) > 1)


def _with_slack(information: FloatArray, score: FloatArray, sigma_m: float) -> tuple[FloatArray, FloatArray]:
    """Each place may be off by this sigma: (L^-1 + s^2)^-1, which L need not have an inverse for.

    That is (I - (I + s^2 L)^-1) / s^2. It takes the place of L, since of many tags one such matrix is large.
    """
    n = len(score)
    if not n or not sigma_m:
        return information, score
    information *= sigma_m**2
    information[np.diag_indices(n)] += 1.0
    # Symmetric, so that its transpose is the same in the order of columns that LAPACK works on in place.
    root, failed = linalg.lapack.dpotrf(information.T, lower=1, overwrite_a=1)
    if failed:
        raise ValueError(f"the information of {n} coordinates of sightings is not positive")
    widened_score = linalg.cho_solve((root, True), score, check_finite=False)
    inverse, _ = linalg.lapack.dpotri(root, lower=1, overwrite_c=1)
    found: FloatArray = inverse.T
    for i in range(n):
        found[i + 1 :, i] = found[i, i + 1 :]
    found *= -(sigma_m**-2)
    found[np.diag_indices(n)] += sigma_m**-2
    return found, widened_score


def contradicted(graph: Graph, state: State, sightings: Sightings, scales: FloatArray) -> BoolArray:
    """(M,) readings before which a tag seems to have moved though it was in sight.

    The poses count as known, which a few metres apart they nearly are: that finds a move too many rather than one too
    few, and whether it is one the joint evidence tells.
    """
    problem = _scaled(graph, scales)
    lin = problem.readings.linearise(state, problem.columns)
    by_tag = lin.blocks[1][1]
    square = np.einsum("mki,mkj->mij", by_tag, by_tag)
    pull = -np.einsum("mki,mk->mi", by_tag, lin.residual)
    cut = np.zeros(len(pull), dtype=np.bool_)
    order = np.lexsort((problem.readings.pose, sightings.of_reading))
    parts = np.split(order, np.cumsum(sightings.n_readings)[:-1]) if len(order) else []
    while parts:
        own = parts.pop()
        if len(own) < 2:
            continue
        before, pulled = np.cumsum(square[own], axis=0), np.cumsum(pull[own], axis=0)
        covariance = np.linalg.inv(before[:-1])
        covariance_after = np.linalg.inv(before[-1] - before[:-1])
        off = np.einsum("nij,nj->ni", covariance, pulled[:-1])
        off -= np.einsum("nij,nj->ni", covariance_after, pulled[-1] - pulled[:-1])
        gain = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance + covariance_after), off)
        at = int(np.argmax(gain)) + 1
        if gain[at - 1] > -2.0 * np.log(_MOVED_IN_SIGHT / len(own)):  # chi-square with 2 degrees
            cut[own[at]] = True
            parts += [own[:at], own[at:]]
    return cut


def _scaled(graph: Graph, scales: FloatArray) -> Problem:
    """The problem under the chains' own noise."""
    problem = graph.problem
    chain_of_pose = np.repeat(np.arange(len(graph.chains)), [len(chain.stamps_ns) for chain in graph.chains])
    by_wheels = scales[chain_of_pose[problem.odometry.first], 0]
    by_reading = scales[chain_of_pose[problem.readings.pose], 1]
    odometry, readings = problem.odometry, problem.readings
    return replace(
        problem,
        odometry=replace(odometry, whitening=odometry.whitening / by_wheels[:, None, None]),
        readings=replace(readings, whitening=readings.whitening / by_reading[:, None, None]),
    )


def _weighed(problem: Problem, state: State, sightings: Sightings) -> Problem:
    """The problem with readings weighed by the others of their sighting.

    Not by where the tag is said to be: what is off together was moved, and is to be heard in full.
    """
    readings = problem.readings
    lin = readings.linearise(state, problem.columns)
    root = np.sqrt(_own_weights(lin.residual, lin.blocks[1][1], sightings))
    return replace(problem, readings=replace(readings, whitening=readings.whitening * root[:, None, None]))


def _own_weights(residual: FloatArray, by_tag: FloatArray, sightings: Sightings) -> FloatArray:
    """(M,) robust weights of readings about the place that their sighting alone gives the tag, poses held."""
    n, of = len(sightings), sightings.of_reading
    weights = np.ones(len(residual))
    for _ in range(_WEIGHINGS):
        square, pull = np.zeros((n, 2, 2)), np.zeros((n, 2))
        np.add.at(square, of, weights[:, None, None] * np.einsum("mki,mkj->mij", by_tag, by_tag))
        np.add.at(pull, of, weights[:, None] * np.einsum("mki,mk->mi", by_tag, residual))
        off = -np.linalg.solve(square, pull[..., None])[..., 0]
        left = residual + np.einsum("mki,mi->mk", by_tag, off[of])
        _, weights = losses_and_weights(DEFAULT_LOSSES.readings, left)
    return weights


def _without_tags(columns: Columns, held: BoolArray) -> Columns:
    """With some of the tags (T,) held, and the rest numbered anew."""
    kept = np.zeros(columns.n, dtype=np.bool_)
    for each in (columns.poses, columns.tags[~held], columns.calibration):
        kept[each[each >= 0]] = True
    number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    return Columns(number[columns.poses], number[columns.tags], number[columns.calibration], int(kept.sum()))
