"""Solve one segment alone, in the frame of its start.

A long drive past few tags has many local minima. It is solved incrementally on a few of its keyframes. Where the solve
from there does not fit, this is repeated under the noise of its windows, first with a more certain calibration, then
with perturbed odometry, until one fits.

Where observations contradict each other everywhere, each of these solves takes a hundred steps instead of four. So that
a small file of them does not take minutes, all share the log's budget: they end early, and the map reports it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.local_map.goodness_of_fit import GoodnessOfFit, Windows, fit_windows
from groundsbot.offline.local_map.incremental_solve import (
    BUILDING_SHARE,
    InitialValues,
    PartialMap,
    inflate_noise,
    perturb_odometry,
    solve_incrementally,
    state_from,
)
from groundsbot.offline.measurements import (
    POSITION_NOISE,
    STAMP_NOISE,
    Segment,
    TagKey,
    coarse_keyframes,
    coarsen,
    informative_keyframes,
    least_shared_variance,
    with_smoothed_faces,
    without_unconfirmed_tracks,
)
from groundsbot.offline.sam import (
    COST_TOLERANCE,
    NOISY_COST_TOLERANCE,
    Budget,
    Graph,
    Parameter,
    Problem,
    Solution,
    State,
    budgets_of,
    build_graph,
    solve,
)

_N_STARTS: Final = 9
# Calibration that is far less certain than the drive can determine at its beginning admits minima with a camera a metre
# off. The second start takes the prior sigmas for a tenth of what they are.
_NARROW_PRIOR: Final = 0.1
# Shares of the log's solve budget.
_WINDOWS_SHARE: Final = 0.2
_SOLVING_SHARE: Final = 0.1  # it is solved several times
# Where windows show far more noise than given, other starts end with the first that gains less than this share.
_MAX_FAILED_STARTS: Final = 1
_LEAST_GAIN: Final = 0.01
# The incremental solve uses the noise of the windows where it is larger than given by this factor. Below it, the larger
# noise would admit wrong minima.
_FAR_LARGER: Final = 1.5
# Corner errors in pixels beyond this have another cause: the stamp, the tag or the mount.
_MOST_CORNER_PX: Final = 1.0
# Largest number of keyframes for the test of goodness of fit, spread over the drive.
_MOST_CHECKED: Final = 2500
_LEAST_SHARE: Final = 0.25
_NEXT_SHARE: Final = 1.4


@dataclass(frozen=True)
class LocalMap:
    """A segment solved in the frame of its start, and its goodness of fit."""

    segment: Segment
    graph: Graph
    solution: Solution
    goodness: GoodnessOfFit
    is_noisy: bool = False  # its windows show far more noise than given, so the noise is fitted before outliers
    unfiltered: Segment | None = None  # with unconfirmed observations, where these were left out of a noisy segment
    n_misread: int = 0  # observations left out as those of another tag, or of none
    is_doubtful: bool = False  # it does not fit even under its fitted noise, so none of its tags is named an outlier
    had_corners: bool = False  # it was computed from corners, which it no longer has

    @property
    def T_start_base(self) -> FloatArray:
        """Poses (K, 3) of the keyframes."""
        return self.solution.state.poses

    @property
    def tags_m(self) -> dict[TagKey, FloatArray]:
        """Position (2,) of each tag in the frame of the start."""
        return self.graph.tags_of(self.solution.state)

    @property
    def calibration(self) -> dict[Parameter, float]:
        """Estimated correction of each calibration parameter to the value in robot.yaml, in the parameter's unit."""
        return self.graph.calibration_of(self.solution.state)

    @property
    def cost_tolerance(self) -> float:
        """Cost tolerance of its solves."""
        return NOISY_COST_TOLERANCE if self.is_noisy else COST_TOLERANCE

    @property
    def as_start(self) -> InitialValues:
        """Initial values of the same drive once it is longer; if it does not fit, no others are tried."""
        return InitialValues.of_solution(self.graph, self.solution.state, 0 if self.goodness.fits else _N_STARTS)

    def without_factorisation(self) -> "LocalMap":
        """Return the map without the cached factorisation of its solution, which may be most of its memory."""
        return replace(self, solution=replace(self.solution))

    def without_systems(self) -> "LocalMap":
        """Return the map without its order of elimination and factorisation, which are computed again where needed."""
        return self._with_problem(replace(self.graph.problem))

    def without_factors(self) -> "LocalMap":
        """Return the map without the factors of its problem, for what needs its estimate and measurements alone."""
        return self._with_problem(self.graph.problem.without_factors())

    def _with_problem(self, problem: Problem) -> "LocalMap":
        graph = replace(self.graph, problem=problem)
        return replace(self, graph=graph, solution=replace(self.solution, problem=problem))

    def with_fixed_noise(self, most_times: int) -> "LocalMap":
        """Return the map without what a fit of the noise and a solve on corners need (`Segment.with_fixed_noise`)."""
        segment, had_corners = self.segment.with_fixed_noise(most_times), self.graph.has_corners
        return replace(self, segment=segment, graph=replace(self.graph, segments=(segment,)), had_corners=had_corners)


def solve_local_map(
    segment: Segment, budget: Budget | None = None, *, noise_is_open: bool = False, start: InitialValues | None = None
) -> LocalMap:
    """Estimate poses, tags and calibration of one segment alone, in the frame of its first keyframe.

    An incremental solution over a few keyframes initialises the solve over all of them. If the result fails the test of
    goodness of fit, up to eight other initial values are tried, until one passes or the computing budget is used up. If
    none passes, the result of least cost is returned, and `LocalMap.goodness` says that it does not fit.

    Args:
        segment: keyframes, odometry and tag observations of a drive, or of a part with unbroken odometry.
        budget: computing budget of the segment, of `budgets_of`; None: that of its whole log.
        noise_is_open: the noise parameters of the segment are initial values and will be fitted later. If the residuals
            of short windows of the drive are far larger than these parameters predict, the noise of the windows is
            used instead. Robots without a calibration are treated so in any case.
        start: initial values of the first solve, where they begin with the segment.

    Raises:
        OfflineError: without a budget, the segment has more observations than a log of its size may have.
    """
    (budget,) = [budget] if budget else budgets_of([segment])
    shown, check = _noise_of_windows(segment, budget, noise_is_open=noise_is_open)
    segment, whole = shown.apply_to(segment)
    far_larger = shown.is_far_larger
    graph = build_graph([segment])
    cost_tolerance = NOISY_COST_TOLERANCE if far_larger else COST_TOLERANCE
    best: LocalMap | None = None
    n_in_vain = 0
    for keyframes, known in _starts(segment, budget, check, far_larger=far_larger, given=start):
        state = state_from(graph, keyframes, known)
        most_tries = budget.max_linearisations(graph.problem, _SOLVING_SHARE)
        solution = solve(graph.problem, state, cost_tolerance, most_tries=most_tries)
        budget.spend(solution)
        n_in_vain += 1
        if best is None or solution.cost < (1.0 - far_larger * _LEAST_GAIN) * best.solution.cost:
            best = LocalMap(
                segment, graph, solution, check.goodness_of_fit(solution), is_noisy=far_larger, unfiltered=whole
            )
            n_in_vain = 0
            if best.goodness.fits:
                break
        is_spent = budget.left < BUILDING_SHARE * budget.allowed
        if is_spent or (far_larger and n_in_vain >= _MAX_FAILED_STARTS):
            break
    if best is None:
        raise ValueError(f"{segment.name}: no start was tried")
    graph.problem.arrowhead.without_scratch()
    return _with_derivatives_at_solution(best, budget) if far_larger or noise_is_open else best


def _starts(
    segment: Segment, budget: Budget, check: "_Check", *, far_larger: bool, given: InitialValues | None
) -> Iterator[tuple[IntArray, PartialMap]]:
    """Yield initial values in the order in which they are tried: keyframes, and the solution at these."""
    n_replaced, known = 0, given and given.near(segment)
    if given is not None and known is not None:
        yield known
        n_replaced = given.n_replaced
    keyframes = coarse_keyframes(segment)
    coarse = coarsen(segment, keyframes)
    other = inflate_noise(coarse, check.noise_factors)
    rng = np.random.default_rng(0)
    for number in range(n_replaced, _N_STARTS):
        if number == 0:
            yield keyframes, solve_incrementally(other if far_larger else coarse, budget)
        elif number == 1:
            yield keyframes, solve_incrementally(other, budget, _NARROW_PRIOR)
        else:
            yield keyframes, solve_incrementally(perturb_odometry(other, rng), budget)


def _with_derivatives_at_solution(local_map: LocalMap, budget: Budget) -> LocalMap:
    """Return the map solved again, with derivatives by camera parameters evaluated at its ranges and headings.

    At those of single pictures they are correlated with their errors: see `Observations.with_edges_at` and
    `smoothed_faces`.
    """
    if not local_map.segment.observations.from_corners.any():
        return local_map
    segment = _evaluate_at(local_map.segment, local_map, local_map.graph, local_map.solution.state)
    graph = build_graph([segment])
    solution = solve(
        graph.problem,
        local_map.solution.state,
        local_map.cost_tolerance,
        most_tries=budget.max_linearisations(graph.problem, _SOLVING_SHARE),
    )
    graph.problem.arrowhead.without_scratch()
    whole = local_map.unfiltered
    if whole is not None:
        unfiltered = build_graph([whole])
        state = unfiltered.start(local_map.T_start_base, local_map.tags_m, local_map.calibration)
        whole = _evaluate_at(whole, local_map, unfiltered, state)
    return replace(local_map, segment=segment, graph=graph, solution=solution, unfiltered=whole)


def _evaluate_at(segment: Segment, local_map: LocalMap, graph: Graph, state: State) -> Segment:
    """Return a segment of a map with its derivatives by camera parameters at a state of its graph."""
    ranges_m = graph.problem.observations.ranges_m(state)
    segment = replace(segment, observations=segment.observations.with_edges_at(ranges_m))
    return with_smoothed_faces(segment, local_map.T_start_base, ranges_m)


class WindowNoise(NamedTuple):
    """Noise of a segment estimated from its windows.

    Attributes:
        is_far_larger: far larger than given, so that it is taken as unknown.
        factors: factors of wheels and observations, as multiples of the given noise.
        extra_noise: names of the position noise that corners have in addition.
    """

    is_far_larger: bool
    factors: tuple[float, float]
    extra_noise: tuple[str, ...]

    def apply_to(self, segment: Segment) -> tuple[Segment, Segment | None]:
        """Return the segment to solve and, where its noise is unknown, the one with unconfirmed observations."""
        if not self.is_far_larger:
            return segment, None
        whole = segment.with_position_noise(self.extra_noise)
        return without_unconfirmed_tracks(whole), whole


def noise_of_windows(segment: Segment) -> WindowNoise:
    """Return the noise from windows of a segment whose given noise is a first guess."""
    budget = Budget.of_log(segment.run.log_bytes, segment.run.inputs)
    return _noise_of_windows(segment, budget, noise_is_open=True)[0]


def first_solution(segment: Segment, shown: WindowNoise, given: InitialValues | None = None) -> tuple[Graph, Solution]:
    """Solve the segment once, whether it fits or not, from initial values or else from the incremental solution."""
    budget = Budget.of_log(segment.run.log_bytes, segment.run.inputs)
    segment, _ = shown.apply_to(segment)
    if shown.is_far_larger:  # under too small a noise a wrong minimum far from the priors costs less than the right one
        wheels, observations = shown.factors  # persistent errors do not show in windows: never below the given noise
        segment = inflate_noise(segment, (max(1.0, wheels), max(1.0, observations)))
    graph, start = build_graph([segment]), given and given.near(segment)
    if start is None:
        keyframes = coarse_keyframes(segment)
        start = keyframes, solve_incrementally(coarsen(segment, keyframes), budget)
    state = state_from(graph, *start)
    return graph, solve(graph.problem, state, most_tries=budget.max_linearisations(graph.problem, _SOLVING_SHARE))


def with_goodness_of_fit(local_map: LocalMap) -> LocalMap:
    """Return the map with a new test of goodness of fit, under the noise that was fitted to whole drives."""
    segment = local_map.segment
    budget = Budget.of_log(segment.run.log_bytes, segment.run.inputs)
    check = _Check(local_map.graph, budget, least_factor=1.0)
    found = replace(local_map, goodness=check.goodness_of_fit(local_map.solution))
    local_map.graph.problem.arrowhead.without_scratch()
    return found


def _noise_of_windows(segment: Segment, budget: Budget, *, noise_is_open: bool) -> tuple[WindowNoise, "_Check"]:
    """Return the noise from windows, and the test for solutions of the segment that `WindowNoise.apply_to` returns."""
    is_left_open = segment.run.robot.is_left_open
    noise_is_open = noise_is_open or is_left_open
    likely = without_unconfirmed_tracks(segment) if is_left_open else segment
    check = _Check(build_graph([likely]), budget, noise_is_open=noise_is_open)
    factors = check.noise_factors if is_left_open else check.trimmed_noise_factors
    is_far_larger = noise_is_open and max(factors) > _FAR_LARGER
    is_beyond_pixels = factors[1] * segment.observations.corner_sigma_px > _MOST_CORNER_PX
    shown = WindowNoise(is_far_larger, check.noise_factors, POSITION_NOISE if is_beyond_pixels else (STAMP_NOISE,))
    applied, whole = shown.apply_to(segment)
    if likely is not segment if whole is None else whole.observations is not segment.observations:
        check = _Check(build_graph([applied]), budget, noise_is_open=noise_is_open)
        shown = shown._replace(factors=check.noise_factors)
    return shown, check


class _Check:
    """Test of solutions of a segment, without most of the poses that observe no tag and have little information."""

    def __init__(self, graph: Graph, budget: Budget, least_factor: float = 0.0, *, noise_is_open: bool = False) -> None:
        (segment,) = graph.segments
        whole = graph
        self._keyframes = informative_keyframes(segment)
        share = _LEAST_SHARE
        while len(self._keyframes) > _MOST_CHECKED:
            self._keyframes = coarse_keyframes(segment, share)
            share *= _NEXT_SHARE
        if len(self._keyframes) < len(segment.stamps_ns):
            segment = coarsen(segment, self._keyframes)
            graph = build_graph([segment])
        # Tags that lose all observations are not in the windows, nor are parameters that only these depend on.
        self._tags = np.array([whole.tags.index(tag) for tag in graph.tags], dtype=np.int64)
        self._calibration = np.array([whole.parameters.index(each) for each in graph.parameters], dtype=np.int64)
        self._windows: Windows = fit_windows(
            graph.problem,
            budget=budget,
            share=_WINDOWS_SHARE,
            least_shared=least_shared_variance(segment.observations),
            least_factor=least_factor,
            noise_is_open=noise_is_open,
        )

    @property
    def noise_factors(self) -> tuple[float, float]:
        """Noise of wheels and of observations as a multiple of the given noise."""
        wheels, observations = self._windows.factors.tolist()
        return wheels, observations

    @property
    def trimmed_noise_factors(self) -> tuple[float, float]:
        """The same without the worst windows."""
        wheels, observations = self._windows.trimmed_factors.tolist()
        return wheels, observations

    def goodness_of_fit(self, solution: Solution) -> GoodnessOfFit:
        state = solution.state
        return self._windows.goodness_of_fit(
            State(state.poses[self._keyframes], state.tags[self._tags], state.calibration[self._calibration])
        )
