"""Joint solve of all runs of a component, and its typed result."""

from collections.abc import Sequence

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import Mount
from groundsbot.offline.alignment import Group
from groundsbot.offline.corners import CornerSolution, Refined
from groundsbot.offline.foundation import Stages, Workers, release_memory
from groundsbot.offline.global_map.initial_values import initial_map
from groundsbot.offline.global_map.tape import with_measurements
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.maps import (
    ArchivedCalibration,
    CalibrationResult,
    Component,
    CrossCovariances,
    MapModel,
    RunResult,
    TagPose,
    TagResult,
    nominal_row,
    start_vectors,
)
from groundsbot.offline.measurements import Measurements, Segment, TagKey
from groundsbot.offline.sam import (
    Graph,
    Parameter,
    Solution,
    State,
    bias_of,
    build_graph,
    covariance_with_bias,
    solve_with_workers,
)


def solve_global_map(
    maps: Sequence[LocalMap],
    group: Group,
    stages: Stages,
    measurements: Measurements | None = None,
    workers: Workers | None = None,
) -> tuple[Graph, Solution]:
    """Solve the members of a group together, starting from their local maps placed by the alignments."""
    members = [maps[m] for m in group.members]
    with stages.stage("initial values of all runs"):
        initial = initial_map(maps, group, workers)
    with stages.stage("building the graph"):
        graph = build_graph([member.segment for member in members])
        graph = with_measurements(graph, measurements) if measurements else graph
        if len(members) == 1 and not len(graph.problem.measured):
            return graph, members[0].solution
        start = initial.state(graph)
    with stages.stage("solving all runs together"):
        cost_tolerance = max(member.cost_tolerance for member in members)
        solution = solve_with_workers(graph.problem, start, cost_tolerance, workers=workers)
        graph.problem.without_arrowhead()  # an outlier search has its own, and it may not be needed again
        return graph, solution


def component_of(graph: Graph, solution: Solution, refined: Refined | None = None) -> Component:
    """Return typed results without edges, in the frame of the first segment's start; refined on corners if given."""
    last = refined.solution if refined else solution
    state, columns = last.state, last.problem.columns
    starts = graph.first_pose
    free = np.flatnonzero(columns.calibration >= 0)
    places = np.concatenate([columns.poses[starts].reshape(-1), columns.tags.reshape(-1)])
    joint, with_calibration = _covariances(last, places, columns.calibration[free])
    _turn_to_map_axes(joint, state.poses[starts, 2])
    n_starts = 3 * len(starts)
    runs = tuple(
        _run_result(
            graph, state, i, joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3].copy(), (refined or graph).mounts_of(state, i)
        )
        for i in range(len(graph.segments))
    )
    tag_covariances = [
        joint[n_starts + 2 * i : n_starts + 2 * i + 2][:, n_starts + 2 * i : n_starts + 2 * i + 2].copy()
        for i in range(len(graph.tags))
    ]
    return Component(
        frame_run=graph.segments[0].name,
        runs=runs,
        tags=_tag_results(graph, state, tag_covariances, refined.tag_poses if refined else [None] * len(graph.tags)),
        joint_covariance=joint,
        cost=last.cost,
        n_residuals=last.problem.n_residuals,
        start_to_start=start_vectors(runs, joint),
        model=MapModel.CORNERS if refined else MapModel.FLOOR,
        floor=refined.floor if refined else None,
        converged=solution.converged,
        calibration=_archived_calibration(
            [(refined or graph).parameters[i] for i in free], state.calibration[free], with_calibration[:, n_starts:]
        ),
    )


def cross_covariances_of(graph: Graph, solution: Solution, refined: Refined | None = None) -> CrossCovariances:
    """Return what `component_of` leaves out of its covariances, and a change of frame needs."""
    last = refined.solution if refined else solution
    state, columns, starts = last.state, last.problem.columns, graph.first_pose
    of_starts = columns.poses[starts].reshape(-1)
    free = columns.calibration[columns.calibration >= 0]
    whole = _covariance(last, np.concatenate([of_starts, free]))
    headings_rad = state.poses[starts, 2]
    return CrossCovariances(
        _turn_starts(whole[len(of_starts) :, : len(of_starts)], headings_rad),
        _turn_starts(refined.attitudes_with(np.concatenate([of_starts, columns.tags.reshape(-1)])), headings_rad)
        if refined
        else None,
    )


def calibration_of(
    parameters: Sequence[Parameter], solution: Solution | CornerSolution, kept: ArchivedCalibration, component: int
) -> list[CalibrationResult]:
    """Return the estimates of the calibration parameters in the solve, with the sigmas that the component has."""
    free = np.flatnonzero(solution.problem.columns.calibration >= 0).tolist()
    sigmas = np.sqrt(np.diag(kept.covariance)).tolist()
    return [
        CalibrationResult(owner, name, component, float(solution.state.calibration[i]), sigma, parameters[i].sigma)
        for i, owner, name, sigma in zip(free, kept.owners, kept.names, sigmas, strict=True)
    ]


def _covariance(solution: Solution | CornerSolution, columns: IntArray) -> FloatArray:
    """Return the joint covariance (k, k) of k columns of the tangent vector, of the bias too where that is known."""
    return covariance_with_bias(solution, columns) if isinstance(solution, Solution) else solution.covariance(columns)


def _covariances(
    solution: Solution | CornerSolution, places: IntArray, calibration: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the joint covariance (k, k) of some columns, and that of others with these and themselves (c, k + c)."""
    columns, k = np.concatenate([places, calibration]), len(places)
    if isinstance(solution, Solution):  # apart, since a copy of thousands of tags takes hundreds of MiB
        change = bias_of(solution)
        release_memory()  # to the system, of a fleet 150 MiB
        joint = covariance_with_bias(solution, places, change=change)
        release_memory()
        return joint, covariance_with_bias(solution, columns, k, change).T
    whole = solution.covariance(columns)
    return whole[:k, :k].copy(), whole[k:]


def _archived_calibration(parameters: Sequence[Parameter], values: FloatArray, rows: FloatArray) -> ArchivedCalibration:
    """Return C calibration parameters with their rows (C, 2 T + C) of the covariance of tags and calibration."""
    n = rows.shape[1] - len(parameters)
    return ArchivedCalibration(
        owners=tuple(parameter.owner for parameter in parameters),
        names=tuple(parameter.name for parameter in parameters),
        nominal=np.array([nominal_row(parameter.nominal) for parameter in parameters]).reshape(
            -1, len(nominal_row(()))
        ),
        values=values,
        covariance=rows[:, n:],
        with_tags=rows[:, :n],
    )


def _turn_to_map_axes(joint: FloatArray, start_headings_rad: FloatArray) -> None:
    """Transform from right perturbations of the starts to (x, y, theta) in map; tags are in map already."""
    for i, theta in enumerate(start_headings_rad):
        cos, sin = np.cos(theta), np.sin(theta)
        turn, place = np.array([[cos, -sin], [sin, cos]]), slice(3 * i, 3 * i + 2)
        joint[place] = turn @ joint[place]
        joint[:, place] = joint[:, place] @ turn.T


def _turn_starts(covariance: FloatArray, start_headings_rad: FloatArray) -> FloatArray:
    """Transform columns (..., n), those of the starts first, as `_turn_to_map_axes`; rows are in map already."""
    turned = covariance.copy()
    for i, theta in enumerate(start_headings_rad):
        cos, sin = np.cos(theta), np.sin(theta)
        turned[..., 3 * i : 3 * i + 2] = turned[..., 3 * i : 3 * i + 2] @ np.array([[cos, sin], [-sin, cos]])
    return turned


def _run_result(graph: Graph, state: State, index: int, covariance: FloatArray, mounts: dict[str, Mount]) -> RunResult:
    segment = graph.segments[index]
    poses = graph.poses_of(state, index)
    return RunResult(
        name=segment.name,
        run=segment.run.name,
        log=segment.run.log,
        robot_id=segment.run.robot_id,
        run_id=segment.run.run_id,
        T_map_start=poses[0],
        covariance=covariance,
        stamps_ns=segment.stamps_ns,
        T_map_base=poses,
        distance_m=float(segment.along_m[-1]),
        T_base_camera=_components(next(iter(mounts.values()))) if mounts else None,
        T_base_cameras={name: _components(mount) for name, mount in mounts.items() if name},
    )


def _components(mount: Mount) -> FloatArray:
    """Return (7,) position and quaternion x, y, z, w."""
    place_m, turn = mount.T_base_camera.as_components()
    return np.concatenate([place_m, turn.as_quat(canonical=True)])


def _tag_results(
    graph: Graph, state: State, covariances: Sequence[FloatArray], poses: Sequence[TagPose | None]
) -> tuple[TagResult, ...]:
    results = []
    segments_with: dict[TagKey, list[Segment]] = {tag: [] for tag in graph.tags}
    for segment in graph.segments:
        for tag in segment.tags:
            segments_with[tag].append(segment)
    for i, (tag, n) in enumerate(zip(graph.tags, graph.n_observations().tolist(), strict=True)):
        seen_by = segments_with[tag]
        robot = seen_by[0].run.robot
        has_size = any(batch.family == tag.family for batch in robot.tags)
        results.append(
            TagResult(
                family=tag.family,
                tag_id=tag.tag_id,
                instance=tag.instance,
                size_m=robot.tag_size_m(tag.family, tag.tag_id)[0] if has_size else None,
                position_m=state.tags[i],
                covariance=covariances[i],
                n_observations=n,
                runs=tuple(segment.name for segment in seen_by),
                pose=poses[i],
            )
        )
    return tuple(results)
