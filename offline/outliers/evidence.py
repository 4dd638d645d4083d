"""What observations say of the place of a tag in each track, all else eliminated: any split is then dense algebra.

Let every track have a place of its own. With poses and calibration eliminated the cost is a quadratic form
q(p) = p' L p / 2 + z' p in these places p, taken from where a solve has them, and to take some of them for one is to
put them equal. So one linearisation tells the cost of every split of every tag: the score test (Rao, 1948) with the
exact joint information of all observations, for all hypotheses at once.

A tag is moved by more than a lean of its board or the remains of a lens shift it: each track may be off by a
centimetre, which the form carries: (L^-1 + s^2)^-1. For that each place gets a prior of a centimetre about where the
solve has it; one factorisation with each track's tag apart then tells all (`joint_information`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.local_map import GoodnessOfFit
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M
from groundsbot.offline.outliers.joint_information import Information, no_information
from groundsbot.offline.outliers.tracks import Tracks
from groundsbot.offline.sam import (
    DEFAULT_LOSSES,
    PLAIN_SQUARES,
    Columns,
    Graph,
    Priors,
    Problem,
    State,
    factorise,
    losses_and_weights,
)

_WEIGHINGS: Final = 5
_MOVED_IN_SIGHT: Final = 1e-4


@dataclass(frozen=True)
class Evidence:
    """The cost as a function of the places of K of the tracks: those of tags that were sighted more than once.

    Attributes:
        which: (K,) indices of the tracks.
        information: (2 K, 2 K) L, and score: (2 K,) z, in squared sigmas by metres from `places_m`.
        places_m: (K, 2) the linearisation point.
    """

    which: IntArray
    information: Information
    score: FloatArray
    places_m: FloatArray


def noise_scales(goodness: Sequence[GoodnessOfFit]) -> FloatArray:
    """(C, 2) how many times larger than told the noise of each segment's wheels and observations is, 1 at least.

    By what the windows of each segment leave over, which no tag that was moved between them raises; where windows do
    not join within that, something that is in no covariance bends the segment, and the covariances say too little.
    """
    rows = []
    for each in goodness:
        bent = 1.0 if each.fits else float(np.sqrt(each.chi_square / max(each.expected, 1)))
        rows.append([bent * max(1.0, each.odometry_factor), bent * max(1.0, each.observation_factor)])
    return np.array(rows).reshape(-1, 2)


@dataclass(frozen=True)
class LinearisedObservations:
    """A problem under its segments' own noise, and what its observations say at a state.

    Attributes:
        residual: (M, 2) of the observations, whitened.
        by_tag: (M, 2, 2) their derivatives by the places of tags.
    """

    problem: Problem
    state: State
    residual: FloatArray
    by_tag: FloatArray


def linearise_observations(graph: Graph, state: State, scales: FloatArray) -> LinearisedObservations:
    """Linearises the observations of a graph.

    Args:
        graph: of some segments.
        state: near an optimum.
        scales: (C, 2) of each segment's noise, see `noise_scales`.
    """
    problem = _scale_noise(graph, scales)
    observations = problem.observations.linearise(state, problem.columns)
    return LinearisedObservations(problem, state, observations.residual, observations.blocks[1][1])


def marginalise(
    at: LinearisedObservations,
    tracks: Tracks,
    unmodelled_sigma_m: float = UNMODELLED_SIGMA_M,
    *,
    weighed: bool = True,
) -> Evidence:
    """Linearises all factors at a state and eliminates all but the tracks' places.

    Args:
        at: the segments that the tracks are of, near an optimum.
        tracks: S of them.
        unmodelled_sigma_m: of each coordinate of a track, beyond what the covariances say.
        weighed: whether observations count by how well they fit the others of their track, or all alike.
    """
    which = np.flatnonzero(np.bincount(tracks.id, minlength=len(tracks.ids))[tracks.id] > 1)
    if not len(which):
        return Evidence(which, no_information(unmodelled_sigma_m), np.zeros(0), np.zeros((0, 2)))
    apart, state = _apart(_reweigh(at, tracks) if weighed else at.problem, at.state, tracks)
    system, _ = apart.arrowhead.linearise(state, *PLAIN_SQUARES)
    system.tag[which] += np.eye(2) * unmodelled_sigma_m**-2
    factorisation, _ = factorise(apart.arrowhead, system, 0.0)
    step = factorisation.solve_in_order(system.gradient)
    by_tag = step[3 * len(state.poses) : 3 * len(state.poses) + 2 * len(tracks)].reshape(-1, 2)
    information = Information(factorisation.square_root_of_tags(which), unmodelled_sigma_m)
    # What is left of the gradient once all else is eliminated, S^-1 times this step, through the slack: s^-2 S S^-1.
    return Evidence(which, information, unmodelled_sigma_m**-2 * by_tag[which].reshape(-1), state.tags[which])


def _apart(problem: Problem, state: State, tracks: Tracks) -> tuple[Problem, State]:
    """Each track with a tag of its own, in the same places; what was measured to a tag was to where it was first."""
    columns, n = problem.columns, len(tracks)
    of_tag, first_observation = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    of_tag[tracks.of_observation] = problem.observations.tag
    first_observation[tracks.of_observation[::-1]] = np.arange(len(problem.observations.tag))[::-1]
    first = np.full(len(columns.tags), -1, dtype=np.int64)
    first[of_tag[::-1]] = np.arange(n)[::-1]
    free_poses, free_calibration = columns.poses >= 0, columns.calibration >= 0
    n_poses = int(free_poses.sum())
    n_all = n_poses + 2 * n + int(free_calibration.sum())
    apart = Columns(
        np.where(free_poses, np.cumsum(free_poses).reshape(free_poses.shape) - 1, -1),
        n_poses + np.arange(2 * n).reshape(n, 2),
        np.where(free_calibration, n_poses + 2 * n + np.cumsum(free_calibration) - 1, -1),
        n_all,
    )
    other = replace(
        problem,
        observations=replace(problem.observations, tag=tracks.of_observation),
        columns=apart,
        anchor=problem.observations.pose[first_observation],
        measured=to_other_tags(problem.measured, first),
    )
    return other, State(state.poses, state.tags[of_tag], state.calibration)


def to_other_tags(measured: Priors, index: IntArray) -> Priors:
    """What was measured, with tags numbered anew by index (T,)."""
    distances = measured.distances
    tag_a, tag_b = (np.where(tag >= 0, index[tag], -1) for tag in (distances.tag_a, distances.tag_b))
    return replace(measured, distances=replace(distances, tag_a=tag_a, tag_b=tag_b))


def find_contradictions(at: LinearisedObservations, tracks: Tracks) -> BoolArray:
    """(M,) observations before which a tag seems to have moved though it was in sight.

    The poses count as known, which a few metres apart they nearly are: that finds a move too many rather than one too
    few, and whether it is one the joint evidence tells.
    """
    square = np.einsum("mki,mkj->mij", at.by_tag, at.by_tag)
    pull = -np.einsum("mki,mk->mi", at.by_tag, at.residual)
    cut = np.zeros(len(pull), dtype=np.bool_)
    order = np.lexsort((at.problem.observations.pose, tracks.of_observation))
    n_observations = tracks.n_observations
    while len(order):
        begins, gain = _best_cuts(square[order], pull[order], n_observations)
        ends = np.cumsum(n_observations)
        found = gain > -2.0 * np.log(_MOVED_IN_SIGHT / n_observations)  # chi-square with 2 degrees
        cut[order[begins[found]]] = True
        # Those that were cut are looked at again, in two parts.
        order = order[np.repeat(found, n_observations)]
        before = (begins - (ends - n_observations))[found]
        n_observations = np.stack([before, n_observations[found] - before], axis=-1).reshape(-1)
    return cut


def _best_cuts(square: FloatArray, pull: FloatArray, n_observations: IntArray) -> tuple[IntArray, FloatArray]:
    """Of tracks one after the other (S,), the observation that would begin another one, and what that brings (S,).

    Args:
        square: (M, 2, 2) information of each observation on the place.
        pull: (M, 2) how it draws it elsewhere.
        n_observations: (S,) of each track.
    """
    ends = np.cumsum(n_observations)
    begins, of = ends - n_observations, np.repeat(np.arange(len(n_observations)), n_observations)
    rows = np.concatenate([square.reshape(-1, 4), pull], axis=1)
    # Within each track, so that rounding does not run on from one to the next.
    up_to = np.concatenate([np.cumsum(each, axis=0) for each in np.split(rows, ends[:-1])])
    inside = np.flatnonzero(np.arange(len(of)) + 1 < ends[of])  # the last observation of a track is before nothing
    gain = np.full(len(of), -np.inf)
    before, after = up_to[inside], up_to[ends[of[inside]] - 1] - up_to[inside]
    covariance, covariance_after = _inverse(before[:, :4].reshape(-1, 2, 2)), _inverse(after[:, :4].reshape(-1, 2, 2))
    off = np.einsum("nij,nj->ni", covariance, before[:, 4:]) - np.einsum("nij,nj->ni", covariance_after, after[:, 4:])
    gain[inside] = np.einsum("ni,nij,nj->n", off, _inverse(covariance + covariance_after), off)
    best = np.maximum.reduceat(gain, begins)
    at = np.full(len(n_observations), len(of), dtype=np.int64)
    is_best = np.flatnonzero(gain == best[of])
    np.minimum.at(at, of[is_best], is_best)
    return at + 1, best


def _inverse(matrices: FloatArray) -> FloatArray:
    """Of symmetric ones (n, 2, 2)."""
    (a, b), (_, d) = matrices[:, 0].T, matrices[:, 1].T
    turned = np.stack([d, -b, -b, a], axis=-1).reshape(-1, 2, 2)
    inverse: FloatArray = turned / (a * d - b * b)[:, None, None]
    return inverse


def _scale_noise(graph: Graph, scales: FloatArray) -> Problem:
    """The problem under the segments' own noise."""
    problem = graph.problem
    segment_of_pose = np.repeat(np.arange(len(graph.segments)), [len(segment.stamps_ns) for segment in graph.segments])
    by_wheels = scales[segment_of_pose[problem.odometry.first], 0]
    by_observation = scales[segment_of_pose[problem.observations.pose], 1]
    odometry, observations = problem.odometry, problem.observations
    return replace(
        problem,
        odometry=replace(odometry, whitening=odometry.whitening / by_wheels[:, None, None]),
        observations=replace(observations, whitening=observations.whitening / by_observation[:, None, None]),
    )


def _reweigh(at: LinearisedObservations, tracks: Tracks) -> Problem:
    """The problem with observations weighed by the others of their track.

    Not by where the tag is said to be: what is off together was moved, and is to be heard in full.
    """
    observations = at.problem.observations
    root = np.sqrt(_own_weights(at.residual, at.by_tag, tracks))
    return replace(
        at.problem, observations=replace(observations, whitening=observations.whitening * root[:, None, None])
    )


def _own_weights(residual: FloatArray, by_tag: FloatArray, tracks: Tracks) -> FloatArray:
    """(M,) robust weights of observations about the place that their passing alone gives the tag, poses held."""
    of = tracks.passing
    n_observations = np.bincount(of)
    order = np.argsort(of, kind="stable")
    begins = np.cumsum(n_observations) - n_observations
    squares = np.einsum("mki,mkj->mij", by_tag, by_tag).reshape(-1, 4)
    rows = np.concatenate([squares, np.einsum("mki,mk->mi", by_tag, residual)], axis=1)[order]
    weights = np.ones(len(residual))
    for _ in range(_WEIGHINGS if len(of) else 0):
        sums = np.add.reduceat(weights[order, None] * rows, begins)
        off = -np.einsum("nij,nj->ni", _inverse(sums[:, :4].reshape(-1, 2, 2)), sums[:, 4:])
        left = residual + np.einsum("mki,mi->mk", by_tag, off[of])
        _, weights = losses_and_weights(DEFAULT_LOSSES.observations, left)
    return weights
