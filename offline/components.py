"""The components of a map: each solved on places, tags that do not belong apart, then on corners; and what they say."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from groundsbot.offline.advice import advise
from groundsbot.offline.checks import checks_of, metre_of
from groundsbot.offline.corner_graph import has_corners
from groundsbot.offline.corner_map import Refined, refine
from groundsbot.offline.fit_results import MeasurementResult, SuspectTag
from groundsbot.offline.global_map import calibration_of, component_of, solve_global_map
from groundsbot.offline.graph import Graph
from groundsbot.offline.joined_goodness import joined_goodness
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measured import Measurements
from groundsbot.offline.measured_map import judged
from groundsbot.offline.merge import Group
from groundsbot.offline.parameter_results import CalibrationResult, CheckResult, MetreResult
from groundsbot.offline.result import AdviceResult, Component
from groundsbot.offline.solver import Solution
from groundsbot.offline.stages import Stages
from groundsbot.offline.suspects import joined, split_together
from groundsbot.offline.suspects_report import suspect_tags
from groundsbot.offline.weak_parts import weak_parts
from groundsbot.offline.workings import Solved


class SolvedComponent(NamedTuple):
    """Runs that hang together, as they were solved.

    Attributes:
        members: of the local maps.
        graph: its chains are the members' in order.
        solution: of the graph, on places of tags.
        suspects: tags that do not belong.
        refined: on corners; None where it is not.
        told: why it is not, where anybody asked; or which tags do not hang as was said.
    """

    members: Group
    graph: Graph
    solution: Solution
    suspects: list[SuspectTag]
    refined: Refined | None = None
    told: tuple[str, ...] = ()


def solved_component(
    maps: Sequence[LocalMap],
    members: Group,
    measurements: Measurements,
    stages: Stages,
    *,
    keep_suspects: bool,
    corners: bool,
    upright_sigma_rad: float | None = None,
) -> SolvedComponent:
    """Solves the members of a group together, tags that do not belong apart unless they are kept."""
    graph, solution = solve_global_map(maps, members, stages, measurements)
    with stages.stage("tags that do not belong"):
        searched = split_together(graph, solution, [maps[m] for m in members.members])
        suspects = suspect_tags(searched)
    graph, solution = searched.graph, searched.solution
    if keep_suspects and suspects:
        graph, solution = solve_global_map([joined(each) for each in maps], members, stages, measurements)
    solved = SolvedComponent(members, graph, solution, suspects)
    if not corners or not has_corners(graph):
        return solved
    with stages.stage("refining on tag corners"):
        refined, told = refine(graph, solution, upright_sigma_rad)
    return solved._replace(refined=refined, told=tuple(told))


@dataclass
class Found:
    """What the components gave, one after the other."""

    components: list[Component] = field(default_factory=list)
    suspects: list[SuspectTag] = field(default_factory=list)
    calibration: list[CalibrationResult] = field(default_factory=list)
    measured: list[MeasurementResult] = field(default_factory=list)
    checks: list[CheckResult] = field(default_factory=list)
    metres: list[MetreResult] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    advice: list[AdviceResult] = field(default_factory=list)

    def take(
        self, maps: Sequence[LocalMap], solved: SolvedComponent, measurements: Measurements, stages: Stages
    ) -> Solved:
        """Takes what one more component says."""
        index = len(self.components)
        members, graph, solution, suspects, refined, told = solved
        self.suspects += suspects
        self.warnings += [f"component {index}: {sentence}" for sentence in told]
        with stages.stage("covariances"):
            self.components.append(component_of(graph, solution, refined))
            last = refined.solution if refined else solution
            self.calibration += calibration_of(refined.parameters if refined else graph.parameters, last, index)
            self.measured += judged(graph, last, measurements, index)
            self.checks += checks_of(graph, solution, index)
            self.metres.append(metre_of(graph, index))
        is_refined, poses = refined is not None, last.state.poses
        del solved, refined, last  # the factor on corners, which nothing below asks
        if not is_refined:  # else the map's sigmas are not those that advice is foretold from
            with stages.stage("advice"):
                self.advice += advise(graph, solution, index)
        if not solution.converged:
            self.warnings.append(
                f"component {index}: the solve did not converge ({solution.reason}); do not trust this map"
            )
        with stages.stage("checking that it fits"):
            self.warnings += weak_parts(graph, solution) + _contradictions(maps, members, index, solution)
        return Solved(members, graph, solution, poses)


def _contradictions(maps: Sequence[LocalMap], members: Group, component: int, solution: Solution) -> list[str]:
    """Runs that do not fit together in themselves, and a component that does not though its runs do."""
    found = [w for m in members.members for w in maps[m].goodness.warnings(maps[m].chain.name)]
    if found or len(members.members) == 1:
        return found
    return joined_goodness([maps[m] for m in members.members], solution).warnings(f"component {component}")
