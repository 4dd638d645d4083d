"""Results and warnings of a map's components, collected for the typed result."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.advice import advise
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages
from groundsbot.offline.global_map import (
    SolvedComponent,
    calibration_of,
    compare_measurements,
    compare_wheels_and_tags,
    component_of,
    cross_covariances_of,
    edges_of,
    joint_goodness_of_fit,
    misfit_of,
    noise_degrees_of_freedom,
    scale_budget,
    scatter_of_passes,
    scatter_warnings,
    weak_constraint_warnings,
)
from groundsbot.offline.local_map import GoodnessOfFit, LocalMap
from groundsbot.offline.mapping.frame import FrameChoice, FramedComponent, in_frame
from groundsbot.offline.mapping.workings import SolvedGroup
from groundsbot.offline.maps import (
    AdviceResult,
    CalibrationResult,
    Component,
    ConsistencyCheck,
    MeasurementResult,
    OutlierTag,
    ScaleBudget,
    inflate_covariances,
    inflate_edges,
)
from groundsbot.offline.measurements import Measurements
from groundsbot.offline.sam import Solution, correct_bias


@dataclass
class Findings:
    """Results of the components, in their order."""

    components: list[Component] = field(default_factory=list)
    outliers: list[OutlierTag] = field(default_factory=list)
    calibration: list[CalibrationResult] = field(default_factory=list)
    measurements: list[MeasurementResult] = field(default_factory=list)
    checks: list[ConsistencyCheck] = field(default_factory=list)
    scale_budgets: list[ScaleBudget] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    excluded_tags: set[tuple[str, int]] = field(default_factory=set)
    advice: list[AdviceResult] = field(default_factory=list)
    frame: FrameChoice = field(default_factory=FrameChoice)
    unframed: list[str] = field(default_factory=list)  # why components are not in the chosen frame

    def add(
        self, maps: list[LocalMap], solved: SolvedComponent, measurements: Measurements, stages: Stages
    ) -> SolvedGroup:
        """Add the results of one more component; its maps lose their factors, which nothing needs after this."""
        index = len(self.components)
        members, graph, solution, suspects, refined, told, left_out = solved
        self.outliers += suspects
        self.excluded_tags |= left_out
        self.warnings += [f"component {index + 1}: {sentence}" for sentence in told]
        own_maps = [maps[m] for m in members.members]
        with stages.stage("checking that it fits"):
            together = goodness_together(own_maps, solution)
            misfit = misfit_of(own_maps, graph, solution, together)
            factor = 1.0 if misfit is None else misfit.variance_factor
            scatter = scatter_of_passes(graph, solution, factor, noise_degrees_of_freedom(own_maps))
            own_maps = [each.without_factors() for each in own_maps]
            for m, each in zip(members.members, own_maps, strict=True):
                maps[m] = each
        if refined is None:
            with stages.stage("covariances"):
                solution = correct_bias(solution, _scatter(own_maps, together))
            with stages.stage("advice"):  # before the covariances of the map, hundreds of MiB, are there
                advice = advise(graph, solution, index)
        else:
            advice = []  # it predicts sigmas without corners
        with stages.stage("covariances"):
            framed = in_frame(
                inflate_covariances(component_of(graph, solution, refined), misfit, scatter),
                self.frame,
                partial(cross_covariances_of, graph, solution, refined),
            )
            self._append(framed, index)
            last = refined.solution if refined else solution
            parameters = refined.parameters if refined else graph.parameters
            if kept := framed.component.calibration:
                self.calibration += calibration_of(parameters, last, kept, index)
            self.measurements += compare_measurements(graph, last, measurements, index)
            self.checks += [
                replace(each, sigma=factor**0.5 * each.sigma)
                for each in compare_wheels_and_tags(graph, solution, index)
            ]
            self.scale_budgets.append(scale_budget(graph, index))
        self.advice += [_advice_in_frame(each, factor**0.5, framed.T_frame_start) for each in advice]
        poses, refined_state = last.state.poses, refined.solution.state if refined else None
        del solved, refined, last  # frees the factorisation on corners, unused below
        if not solution.converged:
            self.warnings.append(
                f"component {index + 1}: the solve did not converge ({solution.reason}); do not trust this map"
            )
        self.warnings += weak_constraint_warnings(graph, solution) + _contradictions(own_maps, index, together)
        self.warnings += scatter_warnings(graph, scatter)
        solution = replace(solution)  # without the factorisation, which takes most memory
        graph.problem.without_arrowhead()
        edges = inflate_edges(edges_of(graph, solution, refined_state), factor)
        self.components[index] = replace(self.components[index], edges=edges)
        return SolvedGroup(members, graph, solution, poses).move_to(framed.T_frame_start)

    def _append(self, framed: FramedComponent, index: int) -> None:
        self.components.append(framed.component)
        self.warnings += framed.warnings
        if framed.reason:
            self.unframed.append(framed.reason)
            name = framed.component.frame_name
            self.warnings.append(f"component {index + 1}: its frame is {name}, not that of --frame: {framed.reason}")

    def check_frame(self) -> None:
        """Raise an error if no component can be expressed in the chosen frame.

        Raises:
            OfflineError: the reason for the first component.
        """
        if self.unframed and len(self.unframed) == len(self.components):
            raise OfflineError(f"--frame {self.frame.text}: {self.unframed[0]}")


def goodness_together(maps: Sequence[LocalMap], solution: Solution) -> GoodnessOfFit | None:
    """Return the goodness of fit of several drives together; None for one drive, or if one alone does not fit."""
    if len(maps) == 1 or not all(each.goodness.fits for each in maps):
        return None
    return joint_goodness_of_fit(maps, solution)


def _scatter(maps: Sequence[LocalMap], together: GoodnessOfFit | None) -> float:
    """Return the chi-square of joining windows and drives relative to its expectation; 0 without a condition."""
    tests = [each.goodness for each in maps] if together is None else [together]
    expected = sum(each.expected for each in tests)
    return sum(each.chi_square for each in tests) / expected if expected else 0.0


def _contradictions(maps: Sequence[LocalMap], component: int, together: GoodnessOfFit | None) -> list[str]:
    """Return warnings about drives that do not fit alone, or about a component whose drives fit only alone."""
    found = [w for each in maps for w in each.goodness.warnings(each.segment.name)]
    return found if together is None else found + together.warnings(f"component {component + 1}")


def _advice_in_frame(advice: AdviceResult, sigma_factor: float, T_frame_start: FloatArray | None) -> AdviceResult:
    """Return advice in the map's frame, with its sigmas scaled to the reported ones."""
    way_m = advice.way_m if T_frame_start is None else se2.apply(T_frame_start, advice.way_m)
    sigma_m, then_m = sigma_factor * advice.sigma_m, sigma_factor * advice.sigma_then_m
    return replace(advice, way_m=way_m, sigma_m=sigma_m, sigma_then_m=then_m)
