"""Solves the keyframes of an online drive that are not marginalised at once, as `localize` solves a log."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.local_map import GoodnessOfFit, LocalMap, solve_local_map
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.localization.online.smoother import Smoother
from groundsbot.offline.localization.placement import Located, locate
from groundsbot.offline.localization.solve_in_map import solve_in_map
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import Parameter, Solution, build_graph

_COMPONENT: Final = 0  # the online localizer has only one
_UNTESTED: Final = GoodnessOfFit(0.0, 0, 0.0, 1.0, 1.0)


def localize_drive(smoother: Smoother, tags: Mapping[TagKey, int], known: MapPrior) -> Located | None:
    """Align a drive with the map as `localize` does, without its present pose; None without tags of the map.

    Args:
        smoother: smoother with the drive.
        tags: index of each observed tag.
        known: the map.
    """
    tags = _present_tags(smoother, tags)
    if not tags.keys() & known.instances.keys():
        return None
    return locate(solve_local_map(smoother.drive.segment(tags)), known, _COMPONENT)


def _present_tags(smoother: Smoother, tags: Mapping[TagKey, int]) -> dict[TagKey, int]:
    """Return the tags that were observed from keyframes that the drive still has."""
    observed = set(smoother.drive.tag.tolist())
    return {tag: index for tag, index in tags.items() if index in observed}


def solve_again(
    smoother: Smoother,
    tags: Mapping[TagKey, int],
    parameters: Sequence[Parameter],
    known: MapPrior,
    placed: Located | None,
) -> None:
    """Solve the drive in the map, with tags that moved released, and set the smoother to the solution.

    Args:
        smoother: smoother with the drive.
        tags: index of each observed tag.
        parameters: parameters of calibration.
        known: the map.
        placed: result of `localize_drive`, as the start of the solve; the smoother's state is the start where None.
    """
    tags = _present_tags(smoother, tags)
    by_index = {index: tag for tag, index in tags.items()}
    marginalised = {index: of_map for index, of_map in smoother.map_tags.items() if index not in by_index}
    held = {by_index[index]: of_map for index, of_map in smoother.map_tags.items() if index in by_index}
    loose: dict[TagKey, TagKey] = {}
    if placed is None or placed.alignment is None:
        start, member = smoother.drive.poses[0].copy(), _local_map(smoother, tags, parameters)
    else:
        start, member = placed.alignment.T_a_b, placed.local_map
        held, loose = placed.matches(), placed.mismatches()
    solved = solve_in_map([member], start[None], [held], [loose], known)
    state, names = solved.solution.state, solved.names[0]
    own = {parameter: i for i, parameter in enumerate(solved.graph.parameters)}
    values = [
        state.calibration[own[parameter]] if parameter in own else value
        for parameter, value in zip(parameters, smoother.calibration.tolist(), strict=True)
    ]
    places = _carry_along(smoother, state.poses[0])
    for tag, index in tags.items():
        places[index] = state.tags[solved.graph.tags.index(names.get(tag, tag))]
    map_tags = {tags[tag]: name for tag, name in names.items() if name in known.index}
    smoother.set_to(state.poses, places, np.array(values), marginalised | map_tags)


def _carry_along(smoother: Smoother, first: FloatArray) -> FloatArray:
    """Return (T, 2) the positions of the smoother's tags where its first pose is moved to `first` (3,)."""
    T = se2.compose(first, se2.inverse(smoother.drive.poses[0]))
    return np.asarray(se2.apply(T, smoother.places_m))


def _local_map(smoother: Smoother, tags: Mapping[TagKey, int], parameters: Sequence[Parameter]) -> LocalMap:
    """Return the smoother's state as a local map, in the frame of its start."""
    segment = smoother.drive.segment(tags)
    graph = build_graph([segment])
    T_start_map = se2.inverse(smoother.drive.poses[0])
    places_m = se2.apply(T_start_map, smoother.places_m)
    places = {tag: places_m[index] for tag, index in tags.items()}
    numbers = dict(zip(parameters, smoother.calibration.tolist(), strict=True))
    state = graph.start(se2.compose(T_start_map, smoother.drive.poses), places, numbers)
    unsolved = Solution(state, (graph.problem.cost(state),), "as smoothed", converged=False, problem=graph.problem)
    return LocalMap(segment, graph, unsolved, _UNTESTED)
