"""A drive online solved as a whole, as `localize` solves a log, when there is time."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from groundsbot.calib.geometry import se2
from groundsbot.offline.local_map import GoodnessOfFit, LocalMap, solve_local_map
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.localization.online.smoother import Smoother
from groundsbot.offline.localization.placement import Located, locate
from groundsbot.offline.localization.solve_in_map import solve_in_map
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import Parameter, Solution, build_graph

_COMPONENT: Final = 0  # there is one only
_UNJUDGED: Final = GoodnessOfFit(0.0, 0, 0.0, 1.0, 1.0)


def localize_drive(smoother: Smoother, tags: Mapping[TagKey, int], known: MapPrior) -> Located | None:
    """Where a drive lies in the map as `localize` would say, whatever holds it; None without tags of the map.

    Args:
        smoother: with the drive.
        tags: index of each tag seen.
        known: the map.
    """
    if not tags.keys() & known.instances.keys():
        return None
    return locate(solve_local_map(smoother.drive.segment(tags)), known, _COMPONENT)


def solve_again(
    smoother: Smoother,
    tags: Mapping[TagKey, int],
    parameters: Sequence[Parameter],
    known: MapPrior,
    placed: Located | None,
) -> None:
    """Solves it all, tags that were moved apart, and has the smoother go on from there.

    Args:
        smoother: with the drive.
        tags: index of each tag seen.
        parameters: of calibration.
        known: the map.
        placed: where the drive lies by `localize_drive`: the start of the solve, which else is the smoother's state.
    """
    by_index = dict(zip(tags.values(), tags, strict=True))
    held = {by_index[index]: of_map for index, of_map in smoother.map_tags.items()}
    loose: dict[TagKey, TagKey] = {}
    if placed is None or placed.alignment is None:
        start, member = smoother.drive.poses[0].copy(), _local_map(smoother, tags, parameters)
    else:
        start, member = placed.alignment.T_a_b, placed.local_map
        held, loose = placed.names(), placed.others()
    found = solve_in_map([member], start[None], [held], [loose], known)
    state, called = found.solution.state, found.called[0]
    own = {parameter: i for i, parameter in enumerate(found.graph.parameters)}
    values = [
        state.calibration[own[parameter]] if parameter in own else value
        for parameter, value in zip(parameters, smoother.calibration.tolist(), strict=True)
    ]
    places = np.array([state.tags[found.graph.tags.index(called.get(tag, tag))] for tag in tags]).reshape(-1, 2)
    holding = {tags[tag]: name for tag, name in called.items() if name in known.index}
    smoother.set_to(state.poses, places, np.array(values), holding)


def _local_map(smoother: Smoother, tags: Mapping[TagKey, int], parameters: Sequence[Parameter]) -> LocalMap:
    """In the frame of its start."""
    segment = smoother.drive.segment(tags)
    graph = build_graph([segment])
    T_start_map = se2.inverse(smoother.drive.poses[0])
    places = dict(zip(tags, se2.apply(T_start_map, smoother.places_m), strict=True))
    numbers = dict(zip(parameters, smoother.calibration.tolist(), strict=True))
    begun = graph.start(se2.compose(T_start_map, smoother.drive.poses), places, numbers)
    unsolved = Solution(begun, (graph.problem.cost(begun),), "as smoothed", converged=False, problem=graph.problem)
    return LocalMap(segment, graph, unsolved, _UNJUDGED)
