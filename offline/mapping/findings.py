"""What the components of a map say, gathered for the result."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from groundsbot.offline.advice import advise
from groundsbot.offline.alignment import Group
from groundsbot.offline.foundation import Stages
from groundsbot.offline.global_map import (
    SolvedComponent,
    calibration_of,
    checks_of,
    component_of,
    joined_goodness,
    judged,
    metre_of,
    weak_parts,
)
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.mapping.workings import Solved
from groundsbot.offline.maps import (
    AdviceResult,
    CalibrationResult,
    CheckResult,
    Component,
    MeasurementResult,
    MetreResult,
    SuspectTag,
)
from groundsbot.offline.measurements import Measurements
from groundsbot.offline.sam import Solution


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
