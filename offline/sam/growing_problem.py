"""The problem of one segment that grows: cut off after some keyframes, without being built anew each time."""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import chain_motions
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import Graph, columns_of, middle_observations
from groundsbot.offline.sam.solver import Problem


class GrowingProblem:
    """The problem of the first keyframes of a segment, for any number of them.

    Tags are in the order in which they are first observed, so a longer problem only appends poses and tags. Parameters
    are those of the whole segment; one that no factor depends on yet has its prior only.

    Attributes:
        tags: all tags in that order.
    """

    def __init__(self, graph: Graph, prior_share: float = 1.0) -> None:
        """Sort the factors of a segment's graph; `prior_share` is a factor on the calibration's prior sigmas."""
        problem = graph.problem
        observations = problem.observations.part(np.argsort(problem.observations.pose, kind="stable"))
        tags, first, index = np.unique(observations.tag, return_index=True, return_inverse=True)
        order = np.argsort(first)
        self.tags: Final = [graph.tags[i] for i in tags[order].tolist()]
        self._first = first[order]
        self._observations = replace(observations, tag=np.argsort(order)[index])
        self._odometry = problem.odometry
        self._prior = replace(problem.prior, sigma=prior_share * problem.prior.sigma)
        self._is_free = problem.columns.calibration >= 0

    def start(self) -> State:
        """Return the state of the first keyframe, before any tag is observed."""
        return State(np.zeros((1, 3)), np.zeros((0, 2)), np.zeros(len(self._is_free)))

    def cut(self, n_keyframes: int) -> Problem:
        """Return the problem of the first keyframes."""
        n_observations = int(np.searchsorted(self._observations.pose, n_keyframes))
        observations = self._observations.part(slice(n_observations))
        n_tags = int(np.searchsorted(self._first, n_observations))
        return Problem(
            odometry=self._odometry.part(slice(n_keyframes - 1)),
            observations=observations,
            prior=self._prior,
            columns=columns_of(n_keyframes, n_tags, self._is_free),
            anchor=middle_observations(observations, n_tags),
        )

    def extend(self, state: State, problem: Problem) -> State:
        """Return a state of fewer keyframes extended by dead reckoning, new tags at the mean of their observations."""
        poses = self.dead_reckon(state, len(problem.columns.poses))
        observations, n_known = problem.observations, len(state.tags)
        new = observations.part(observations.tag >= n_known)
        number, n = new.tag - n_known, len(problem.columns.tags) - n_known
        places = new.places_in_map(State(poses, state.tags, state.calibration))
        count = np.bincount(number, minlength=n)
        mean = np.stack([np.bincount(number, places[:, axis], n) / count for axis in (0, 1)], axis=-1)
        return State(poses, np.concatenate([state.tags, mean]), state.calibration)

    def dead_reckon(self, state: State, n_keyframes: int) -> FloatArray:
        """Return poses (n, 3): those of the state, then dead reckoning from the last one under its calibration."""
        n_known = len(state.poses)
        rest = self._odometry.part(slice(n_known - 1, n_keyframes - 1))
        if not len(rest.motion):
            return state.poses
        return np.concatenate([state.poses, chain_motions(rest.predict(state), state.poses[-1])[1:]])
