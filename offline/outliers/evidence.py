"""Evidence of all observations about the place of a tag in each track, with all other variables eliminated.

Let every track have its own place. With poses and calibration eliminated, the cost is a quadratic form
q(p) = p' L p / 2 + z' p in these places p, relative to those of a solve. To join tracks is to set their places equal.
So one linearisation gives the cost of every split of every tag, as dense algebra. This is the score test (Rao, 1948)
with the exact joint information of all observations, for all hypotheses at once.

Tilted boards and errors of the lens model shift a tag by about a centimetre, without a move. So each track may be off
by s = 1 cm, which makes the information (L^-1 + s^2)^-1. It is computed with a prior of sigma s on each place, from
one factorisation with a separate tag for each track (`joint_information`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.foundation import release_memory
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

_REWEIGHTINGS: Final = 5
# Probability that a track whose tag did not move is cut, if its observations are independent.
_CUT_FALSE_ALARM: Final = 1e-4


@dataclass(frozen=True)
class Evidence:
    """Cost as a function of the places of K tracks: those of tags that have more than one track.

    Attributes:
        which: (K,) indices of the tracks.
        information: (2 K, 2 K) L, in 1/m^2.
        score: (2 K,) z, in 1/m.
        places_m: (K, 2) the linearisation point.
    """

    which: IntArray
    information: Information
    score: FloatArray
    places_m: FloatArray


def noise_scales(goodness: Sequence[GoodnessOfFit]) -> FloatArray:
    """Return factors (C, 2) of the noise of each segment's wheels and observations relative to the given, 1 at least.

    They come from the residuals of each segment's windows, which a tag that moves between windows does not raise.
    Windows that do not join within this noise show that something unmodelled distorts the segment. Both factors are
    then multiplied by the square root of chi-square over its expectation.
    """
    rows = []
    for each in goodness:
        misfit = 1.0 if each.fits else float(np.sqrt(each.chi_square / max(each.expected, 1)))
        rows.append([misfit * max(1.0, each.odometry_factor), misfit * max(1.0, each.observation_factor)])
    return np.array(rows).reshape(-1, 2)


@dataclass(frozen=True)
class LinearisedObservations:
    """A problem under the noise of its segments, with its observations linearised at a state.

    Attributes:
        residual: (M, 2) whitened residuals of the observations.
        by_tag: (M, 2, 2) derivatives of the residuals with respect to tag positions, in 1/m.
    """

    problem: Problem
    state: State
    residual: FloatArray
    by_tag: FloatArray


def linearise_observations(graph: Graph, state: State, scales: FloatArray) -> LinearisedObservations:
    """Linearise the observations of a graph.

    Args:
        graph: graph of C segments.
        state: near an optimum.
        scales: (C, 2) factors of each segment's noise, see `noise_scales`.
    """
    problem = _scale_noise(graph, scales)
    observations = problem.observations.linearise(state, problem.columns)
    by_tag = observations.blocks[1][1].copy()  # a view would hold the derivatives by all variables
    return LinearisedObservations(problem, state, observations.residual, by_tag)


def marginalise(
    at: LinearisedObservations,
    tracks: Tracks,
    unmodelled_sigma_m: float = UNMODELLED_SIGMA_M,
    *,
    reweight: bool = True,
) -> Evidence:
    """Linearise all factors at a state and eliminate all variables but the places of the tracks.

    Args:
        at: the segments of the tracks, near an optimum.
        tracks: S tracks.
        unmodelled_sigma_m: sigma of each coordinate of a track's place beyond the covariances.
        reweight: whether to weight observations by how well they fit the others of their track; else all weights are 1.
    """
    which = np.flatnonzero(np.bincount(tracks.id, minlength=len(tracks.ids))[tracks.id] > 1)
    if not len(which):
        return Evidence(which, no_information(unmodelled_sigma_m), np.zeros(0), np.zeros((0, 2)))
    split, state = _split_all(_reweigh(at, tracks) if reweight else at.problem, at.state, tracks)
    system, _ = split.arrowhead.linearise(state, *PLAIN_SQUARES)
    system.tag[which] += np.eye(2) * unmodelled_sigma_m**-2
    factorisation, _ = factorise(split.arrowhead, system, 0.0)
    step = factorisation.solve_in_order(system.gradient)
    del system
    factorisation = factorisation.without_poses()
    release_memory()  # to the system, of a fleet a GiB that is not needed again
    step_of_tags = step[3 * len(state.poses) : 3 * len(state.poses) + 2 * len(tracks)].reshape(-1, 2)
    information = Information(factorisation.square_root_of_tags(which), unmodelled_sigma_m)
    # The gradient with all else eliminated is S^-1 times this step. The slack multiplies it by s^-2 S.
    return Evidence(which, information, unmodelled_sigma_m**-2 * step_of_tags[which].reshape(-1), state.tags[which])


def _split_all(problem: Problem, state: State, tracks: Tracks) -> tuple[Problem, State]:
    """Return the problem and state with a separate tag for each track, at the position of its tag.

    Measured distances then refer to the first track of each tag.
    """
    columns, n = problem.columns, len(tracks)
    of_tag, first_observation = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    of_tag[tracks.of_observation] = problem.observations.tag
    first_observation[tracks.of_observation[::-1]] = np.arange(len(problem.observations.tag))[::-1]
    first = np.full(len(columns.tags), -1, dtype=np.int64)
    first[of_tag[::-1]] = np.arange(n)[::-1]
    free_poses, free_calibration = columns.poses >= 0, columns.calibration >= 0
    n_poses = int(free_poses.sum())
    n_all = n_poses + 2 * n + int(free_calibration.sum())
    split = Columns(
        np.where(free_poses, np.cumsum(free_poses).reshape(free_poses.shape) - 1, -1),
        n_poses + np.arange(2 * n).reshape(n, 2),
        np.where(free_calibration, n_poses + 2 * n + np.cumsum(free_calibration) - 1, -1),
        n_all,
    )
    other = replace(
        problem,
        observations=replace(problem.observations, tag=tracks.of_observation),
        columns=split,
        anchor=problem.observations.pose[first_observation],
        measured=to_other_tags(problem.measured, first),
    )
    return other, State(state.poses, state.tags[of_tag], state.calibration)


def to_other_tags(measured: Priors, index: IntArray) -> Priors:
    """Return the priors with the tags of distances replaced by their entries in index (T,)."""
    distances = measured.distances
    tag_a, tag_b = (np.where(tag >= 0, index[tag], -1) for tag in (distances.tag_a, distances.tag_b))
    return replace(measured, distances=replace(distances, tag_a=tag_a, tag_b=tag_b))


def find_contradictions(at: LinearisedObservations, tracks: Tracks) -> BoolArray:
    """Return whether a tag seems to have moved before each observation (M,), although it stayed in sight.

    Poses are taken as known, which is nearly true within a few metres. This finds too many moves rather than too few.
    The joint evidence then decides which of them to keep.
    """
    information = np.einsum("mki,mkj->mij", at.by_tag, at.by_tag)
    score = -np.einsum("mki,mk->mi", at.by_tag, at.residual)
    cut = np.zeros(len(score), dtype=np.bool_)
    order = np.lexsort((at.problem.observations.pose, tracks.of_observation))
    n_observations = tracks.n_observations
    while len(order):
        begins, gain = _best_cuts(information[order], score[order], n_observations)
        ends = np.cumsum(n_observations)
        found = gain > -2.0 * np.log(_CUT_FALSE_ALARM / n_observations)  # chi-square with 2 degrees of freedom
        cut[order[begins[found]]] = True
        # Both parts of a cut track are tested again.
        order = order[np.repeat(found, n_observations)]
        before = (begins - (ends - n_observations))[found]
        n_observations = np.stack([before, n_observations[found] - before], axis=-1).reshape(-1)
    return cut


def _best_cuts(information: FloatArray, score: FloatArray, n_observations: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the best cut of each of S consecutive tracks in two.

    Args:
        information: (M, 2, 2) of each observation about the place, in 1/m^2.
        score: (M, 2) negative gradient of the cost by the place, in 1/m.
        n_observations: (S,) of each track.

    Returns:
        (S,) the observation that begins the second part, and (S,) the decrease of the cost in squared sigmas.
    """
    ends = np.cumsum(n_observations)
    begins, of = ends - n_observations, np.repeat(np.arange(len(n_observations)), n_observations)
    rows = np.concatenate([information.reshape(-1, 4), score], axis=1)
    # Summed for each track by itself, so that rounding errors do not accumulate over tracks.
    up_to = np.concatenate([np.cumsum(each, axis=0) for each in np.split(rows, ends[:-1])])
    inside = np.flatnonzero(np.arange(len(of)) + 1 < ends[of])  # no cut after the last observation of a track
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
    """Return the inverses of symmetric matrices (n, 2, 2); zeros where one is singular by rounding.

    That is so where a wrong solve puts a tag into a camera, whose bearing then changes without bound.
    """
    (a, b), (_, d) = matrices[:, 0].T, matrices[:, 1].T
    adjugate = np.stack([d, -b, -b, a], axis=-1).reshape(-1, 2, 2)
    determinant = (a * d - b * b)[:, None, None]
    inverse: FloatArray = np.divide(adjugate, determinant, out=np.zeros_like(adjugate), where=determinant > 0.0)
    return inverse


def _scale_noise(graph: Graph, scales: FloatArray) -> Problem:
    """Return the problem of a graph with the noise of each segment multiplied by its factors (C, 2)."""
    problem = graph.problem
    if (scales == 1.0).all():  # as under fitted noise
        return problem
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
    """Return the problem with each observation weighted by how well it fits the others of its track.

    The estimated position of the tag is not used: if all observations of a track contradict it, the tag moved, and they
    count with full weight.
    """
    observations = at.problem.observations
    root = np.sqrt(_own_weights(at.residual, at.by_tag, tracks))
    return replace(
        at.problem, observations=replace(observations, whitening=observations.whitening * root[:, None, None])
    )


def _own_weights(residual: FloatArray, by_tag: FloatArray, tracks: Tracks) -> FloatArray:
    """Return robust weights (M,) of observations about the place that their ungrouped track gives, poses fixed."""
    of = tracks.ungrouped
    n_observations = np.bincount(of)
    order = np.argsort(of, kind="stable")
    begins = np.cumsum(n_observations) - n_observations
    squares = np.einsum("mki,mkj->mij", by_tag, by_tag).reshape(-1, 4)
    rows = np.concatenate([squares, np.einsum("mki,mk->mi", by_tag, residual)], axis=1)[order]
    weights = np.ones(len(residual))
    for _ in range(_REWEIGHTINGS if len(of) else 0):
        sums = np.add.reduceat(weights[order, None] * rows, begins)
        step_m = -np.einsum("nij,nj->ni", _inverse(sums[:, :4].reshape(-1, 2, 2)), sums[:, 4:])
        about_track = residual + np.einsum("mki,mi->mk", by_tag, step_m[of])
        _, weights = losses_and_weights(DEFAULT_LOSSES.observations, about_track)
    return weights
