"""The components of a map: each solved on places, tags that do not belong apart, then on corners; and what they say."""

from collections.abc import Sequence
from typing import NamedTuple

from groundsbot.offline.alignment import Group
from groundsbot.offline.corners import Refined, refine
from groundsbot.offline.foundation import Stages
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.maps import (
    SuspectTag,
)
from groundsbot.offline.measurements import Measurements
from groundsbot.offline.outliers import joined, split_together, suspect_tags
from groundsbot.offline.sam import Graph, Solution


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
    suspects: list[SuspectTag] = []
    # Where a drive does not fit whatever its noise, what tags seem to have done is that drive's doing.
    if not any(maps[m].is_doubtful for m in members.members):
        with stages.stage("tags that do not belong"):
            searched = split_together(graph, solution, [maps[m] for m in members.members])
            suspects = suspect_tags(searched)
        graph, solution = searched.graph, searched.solution
    if keep_suspects and suspects:
        graph, solution = solve_global_map([joined(each) for each in maps], members, stages, measurements)
    solved = SolvedComponent(members, graph, solution, suspects)
    if not corners or not graph.has_corners:
        return solved
    with stages.stage("refining on tag corners"):
        refined, told = refine(graph, solution, upright_sigma_rad)
    return solved._replace(refined=refined, told=tuple(told))
