"""Solve each component of a map: on tag positions, with outliers split off, then on corners."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from groundsbot.calib.foundation import plural
from groundsbot.offline.alignment import Group
from groundsbot.offline.corners import Refined, refine
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.global_map.goodness_of_fit import joint_goodness_of_fit
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.maps import (
    OutlierTag,
)
from groundsbot.offline.measurements import Measurements, TagKey
from groundsbot.offline.outliers import (
    OutlierSearch,
    find_false_detections,
    join_places,
    outlier_report,
    read_as_another,
    split_together,
    stray_passes,
    without_tags,
)
from groundsbot.offline.sam import Graph, Solution


class SolvedComponent(NamedTuple):
    """A solved component.

    Attributes:
        members: members of the local maps.
        graph: its segments are the members' in order.
        solution: solution of the graph, on tag positions.
        outliers: outlier tags.
        refined: the map refined on corners; None where it is not.
        messages: sentences: what was left out, why it is not refined although requested, or which tags are not upright.
        excluded_tags: family and id of tags some or all of whose observations are not in the graph.
    """

    members: Group
    graph: Graph
    solution: Solution
    outliers: list[OutlierTag]
    refined: Refined | None = None
    messages: tuple[str, ...] = ()
    excluded_tags: frozenset[tuple[str, int]] = frozenset()


def solve_group(
    maps: Sequence[LocalMap],
    members: Group,
    measurements: Measurements,
    stages: Stages,
    workers: Workers,
    *,
    keep_suspects: bool,
    corners: bool,
    upright_sigma_rad: float | None = None,
) -> SolvedComponent:
    """Solve the members of a group together, with outlier tags split off unless they are kept."""
    graph, solution = solve_global_map(maps, members, stages, measurements, workers)
    suspects: list[OutlierTag] = []
    messages: list[str] = []
    gone: set[TagKey] = set()
    with stages.stage("tags that do not belong"):
        searched = _search_outliers(graph, solution, [maps[m] for m in members.members], workers)
        if searched is not None:
            suspects, gone, messages = _outlier_report(
                searched, noise_is_fitted=any(maps[m].is_noisy for m in members.members)
            )
            graph, solution = searched.graph, searched.solution
            del searched  # its evidence takes hundreds of MiB
            graph, solution = without_tags(graph, solution, gone)
    if keep_suspects and suspects:
        graph, solution = solve_global_map([join_places(each) for each in maps], members, stages, measurements, workers)
    if misread := read_as_another(graph, solution, [maps[m] for m in members.members]):
        graph, solution = without_tags(graph, solution, misread)
        gone |= misread
        ids = _list_ids({(tag.family, tag.tag_id) for tag in misread})
        messages = [
            *messages,
            f"tags {ids} were each read once at another tag's place; taken for misread codes and left out",
        ]
    left_out = frozenset((tag.family, tag.tag_id) for tag in gone)
    solved = SolvedComponent(members, graph, solution, suspects, messages=tuple(messages), excluded_tags=left_out)
    if not corners or not graph.has_corners:
        return solved
    with stages.stage("refining on tag corners"):
        refined, more = refine(graph, solution, upright_sigma_rad)
    return solved._replace(refined=refined, messages=(*messages, *more))


def _search_outliers(
    graph: Graph, solution: Solution, maps: Sequence[LocalMap], workers: Workers
) -> OutlierSearch | None:
    """Return the search for outlier tags, which splits them off; None where the drives do not fit even then.

    Where a drive does not fit under its fitted noise, or the drives do not fit together, something else violates the
    model, and apparent outliers are not the tags' fault.
    """
    if any(each.is_doubtful for each in maps):
        return None
    searched = split_together(graph, solution, maps, workers)
    if searched is None or not any(each.is_noisy for each in maps):
        return searched
    return searched if len(maps) == 1 or joint_goodness_of_fit(maps, searched.solution).fits else None


def _outlier_report(
    searched: OutlierSearch, *, noise_is_fitted: bool
) -> tuple[list[OutlierTag], set[TagKey], list[str]]:
    """Return the outlier tags, the tags to leave out, and a sentence about those that are not named.

    Fitted noise has heavier tails than a normal distribution: there a deviating pass does not make its tag an outlier.
    """
    suspects, stray = outlier_report(searched), set[TagKey]()
    messages = []
    if noise_is_fitted and (stray := stray_passes(searched)):
        ids = {(tag.family, tag.tag_id) for tag in stray}
        suspects = [each for each in suspects if (each.family, each.tag_id) not in ids]
        n = sum(
            n
            for tag, n in zip(searched.graph.tags, searched.graph.n_observations().tolist(), strict=True)
            if tag in stray
        )
        messages.append(
            f"{len(stray)} {'pass' if len(stray) == 1 else 'passes'} ({plural(n, 'observation')}) of tags "
            f"{_list_ids(ids)} contradict all other passes and were left out"
        )
    return suspects, stray | find_false_detections(searched.graph, suspects), messages


def _list_ids(ids: Collection[tuple[str, int]]) -> str:
    return ", ".join(str(tag_id) for _, tag_id in sorted(ids))
