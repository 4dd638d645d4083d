"""Incremental solve of a segment, whose result is the initial value of the solve of the whole."""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.measurements import Segment, TagKey, refine_poses
from groundsbot.offline.sam import (
    Budget,
    Graph,
    GrowingProblem,
    Parameter,
    State,
    build_graph,
    odometry_parameters_of,
    solve,
)

# A segment is solved incrementally in pieces over which dead reckoning stays in the basin of the right minimum: at most
# this long, and at most as long as its heading is known to this sigma, under the noise and the wheel calibration from
# the previous pieces. They grow with the distance, so that the time does not grow with its square.
_PIECE_M: Final = 10.0
_PIECE_SHARE: Final = 0.01
_PIECE_HEADING_RAD: Final = 0.5  # so that three sigmas are within a quarter turn
# In squared sigmas: a piece only initialises the next.
_PIECE_COST_TOLERANCE: Final = 0.1
# A piece takes three to five steps on any drive, with one linearisation each.
_MOST_TRIES_A_PIECE: Final = 60
# Keyframes whose stamps differ by less have nearly the same pose.
_NEAR_NS: Final = 1_000_000_000
# Share of the log's solve budget.
BUILDING_SHARE: Final = 0.5


class PartialMap(NamedTuple):
    """Incremental solution of a segment so far."""

    poses: FloatArray
    tags: dict[TagKey, FloatArray]
    calibration: dict[Parameter, float]


def solve_incrementally(segment: Segment, budget: Budget, prior_share: float = 1.0) -> PartialMap:
    """Solve the segment incrementally, each piece from the solution of the last; dead reckoning beyond the budget.

    Args:
        segment: segment at some of its keyframes.
        budget: solve budget of the whole segment.
        prior_share: factor on the prior sigmas of the calibration.
    """
    enough = budget.left - BUILDING_SHARE * budget.allowed
    pieces, n_keyframes, n_all = PieceEnds(segment), 1, len(segment.stamps_ns)
    graph = build_graph([segment])
    growing = GrowingProblem(graph, prior_share)
    state = growing.start()
    while True:
        n_keyframes = pieces.next_end(n_keyframes)
        problem = growing.cut(n_keyframes)
        most_tries = budget.max_linearisations(problem, BUILDING_SHARE, _MOST_TRIES_A_PIECE)
        start = growing.extend(state, problem)
        solution = solve(problem, start, _PIECE_COST_TOLERANCE, most_tries=most_tries, keep_factorisation=True)
        budget.spend(solution)
        state = solution.state
        if n_keyframes == n_all or budget.left < enough:
            break
        pieces.covariance = solution.covariance(problem.columns.calibration[graph.odometry_parameters(0)])
    return PartialMap(
        growing.dead_reckon(state, n_all),
        dict(zip(growing.tags, state.tags, strict=False)),
        graph.calibration_of(state),
    )


class InitialValues(NamedTuple):
    """Initial values of the solve of a segment: its solution at some of its keyframes.

    Attributes:
        stamps_ns: (k,) stamps of these keyframes.
        known: the solution at these.
        n_replaced: number of the initial values that `solve_local_map` computes which are not tried after these.
    """

    stamps_ns: IntArray
    known: PartialMap
    n_replaced: int

    @staticmethod
    def of_solution(graph: Graph, state: State, n_replaced: int) -> "InitialValues":
        """Return the initial values from a state of the graph of a single segment."""
        known = PartialMap(state.poses, graph.tags_of(state), graph.calibration_of(state))
        return InitialValues(graph.segments[0].stamps_ns, known, n_replaced)

    def near(self, segment: Segment) -> tuple[IntArray, PartialMap] | None:
        """Return a segment's keyframes nearest to these in time, and the solution there; None if it begins elsewhere.

        They have the same stamps unless the camera's time offset was corrected in between.
        """
        after = np.minimum(np.searchsorted(segment.stamps_ns, self.stamps_ns), len(segment.stamps_ns) - 1)
        before = np.maximum(after - 1, 0)
        to_after, to_before = (np.abs(segment.stamps_ns[each] - self.stamps_ns) for each in (after, before))
        is_near = np.minimum(to_after, to_before) <= _NEAR_NS
        keyframes, index = np.unique(np.where(to_before < to_after, before, after)[is_near], return_index=True)
        if not len(keyframes) or keyframes[0] > 0:
            return None
        return keyframes, self.known._replace(poses=self.known.poses[is_near][index])


def state_from(graph: Graph, keyframes: IntArray, known: PartialMap) -> State:
    """Return the initial state of a segment's graph from a solution at some of its keyframes."""
    (segment,) = graph.segments
    corrections = np.array([known.calibration.get(each, 0.0) for each in odometry_parameters_of(segment)])
    poses = refine_poses(segment, keyframes, known.poses, corrections)
    return graph.start(poses, known.tags, known.calibration)


class PieceEnds:
    """Numbers of keyframes at which the incremental solve stops; the last is all of them.

    Attributes:
        covariance: (P, P) of the odometry's parameters, as estimated so far; initially that of robot.yaml.
    """

    def __init__(self, segment: Segment) -> None:
        self._along_m = segment.along_m
        odometry = segment.odometry
        # Of the heading at each keyframe: derivative with respect to the wheels' parameters, and noise variance.
        self._by_wheels = np.cumsum(np.pad(odometry.jacobian[:, 2], ((1, 0), (0, 0))), axis=0)
        self._noise_rad2 = np.cumsum(np.pad(odometry.covariance[:, 2, 2], (1, 0)))
        self.covariance = np.diag([each.sigma**2 for each in odometry_parameters_of(segment)])

    def next_end(self, n_keyframes: int) -> int:
        """Return the end of the piece after this many keyframes."""
        last, rest = n_keyframes - 1, slice(n_keyframes, None)
        way_m, grown_m = self._along_m[rest] - self._along_m[last], _PIECE_SHARE * self._along_m[rest]
        by_wheels = self._by_wheels[rest] - self._by_wheels[last]
        variance_rad2 = self._noise_rad2[rest] - self._noise_rad2[last]
        variance_rad2 += np.einsum("ki,ij,kj->k", by_wheels, self.covariance, by_wheels)
        ends = way_m >= np.maximum(_PIECE_M, grown_m)
        ends |= (variance_rad2 > _PIECE_HEADING_RAD**2) & (way_m >= grown_m)
        return n_keyframes + int(np.argmax(ends)) + 1 if ends.any() else len(self._along_m)


def inflate_noise(segment: Segment, factors: tuple[float, float]) -> Segment:
    """Return the segment under the noise that its windows show: too large a noise makes wrong minima fit as well."""
    of_wheels, of_observations = factors
    return replace(
        segment,
        odometry=replace(segment.odometry, covariance=of_wheels**2 * segment.odometry.covariance),
        observations=segment.observations.inflate(np.full((len(segment.observations), 2), of_observations)),
    )


def perturb_odometry(segment: Segment, rng: np.random.Generator) -> Segment:
    """Return the segment with another draw of the wheels' noise: an equally likely drive with other local minima."""
    odometry = segment.odometry
    error = np.linalg.cholesky(odometry.covariance) @ rng.standard_normal((len(odometry), 3, 1))
    return replace(segment, odometry=replace(odometry, motion=se2.compose(odometry.motion, se2.exp(error[..., 0]))))
