"""Sets measured distances aside that the map made without them contradicts, before they can bend it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from groundsbot.offline.global_map import SolvedComponent, compare_distances, misfit_of
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.mapping.findings import goodness_together
from groundsbot.offline.maps import MeasurementResult
from groundsbot.offline.measurements import Measurements

# In sigmas of the distance and the map together. No normal error is this large, and the sigmas of a map that fits are
# right within a factor of two: it is a mistaken unit, number or end, or the scale of robot.yaml is wrong.
_MOST_SIGMAS: Final = 10.0


def set_aside_distances(
    maps: Sequence[LocalMap], components: Sequence[SolvedComponent], measurements: Measurements
) -> tuple[Measurements, list[MeasurementResult]]:
    """Return the measurements without distances that contradict a map, and these as results.

    Args:
        maps: local maps.
        components: solved without any of the distances.
        measurements: all of them.
    """
    found: list[MeasurementResult] = []
    kept = measurements.distances
    for solved in components:
        graph, solution = solved.graph, solved.solution
        if not solution.converged:
            continue
        own_maps = [maps[m] for m in solved.members.members]
        misfit = misfit_of(own_maps, graph, solution, goodness_together(own_maps, solution))
        last = solved.refined.solution if solved.refined else solution
        for distance, result in compare_distances(graph, last, measurements, misfit):
            if result.off_sigmas is not None and result.off_sigmas > _MOST_SIGMAS:
                kept = tuple(each for each in kept if each != distance)
                found.append(replace(result, contradicts=True))
    return replace(measurements, distances=kept), found
