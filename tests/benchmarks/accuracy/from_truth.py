"""The most likely map by the true noise, looked for from the truth: what no way of starting a solve could better."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.corners.bundle_adjustment import refine
from groundsbot.offline.evaluation.truth import Truth
from groundsbot.offline.global_map.joint_solve import component_of
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import Graph
from groundsbot.offline.sam.solver import solve


def most_likely_from_truth(runs: Sequence[Run], truth: Truth, noise: NoiseParameters = NoiseParameters()) -> MapResult:
    """The map on corners of all factors of a map, solved from true poses and places, calibration as the files have it.

    First on the floor, from the truth: its most likely map is metres away from it in a hall of a hundred, which corners
    alone take too many steps for.

    Args:
        runs: simulated.
        truth: of them.
        noise: under which they were simulated.

    Raises:
        ValueError: the map is in several parts, or the solve from the truth comes to no end.
    """
    workings = Diagnostics(keeps_corners=True)
    result = build_map(runs, noise, workings=workings)
    if len(result.components) > 1:
        raise ValueError(f"{len(result.components)} components; {'; '.join(result.warnings)}")
    (solved,) = workings.components
    refined, told = refine(solved.graph, solve(solved.graph.problem, _true_state(solved.graph, truth)))
    if refined is None:
        raise ValueError("; ".join(told))
    return replace(result, components=(component_of(solved.graph, solved.solution, refined),))


def _true_state(graph: Graph, truth: Truth) -> State:
    """Poses and tags as they were, in the frame of the first segment's start; no correction of any calibration."""
    T_world_base = [truth.runs[segment.run.name].poses_at(segment.stamps_ns)[0] for segment in graph.segments]
    T_map_world = se2.inverse(T_world_base[0][0])
    tags = {tag: se2.apply(T_map_world, truth.tags_m[tag.family, tag.tag_id, ""]) for tag in graph.tags}
    return graph.start(se2.compose(T_map_world, np.concatenate(T_world_base)), tags, {})
