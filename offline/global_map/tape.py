"""Measurements by a person: as factors of a component's solve, and tested against the map without them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners import CornerSolution
from groundsbot.offline.maps import MeasurementResult, Misfit
from groundsbot.offline.measurements import MeasuredDistance, MeasuredStart, Measurements, TagKey
from groundsbot.offline.sam import (
    DistanceFactors,
    Graph,
    Linearised,
    Priors,
    Solution,
    StartFactors,
    State,
    ends_of,
    whitening,
)

# False alarm rate of the test of a measurement.
_FALSE_ALARM: Final = 1e-4
# A measurement is not tested where everything else is a thousand times less certain.
_CHECKED: Final = 1e-6


def with_measurements(graph: Graph, measurements: Measurements) -> Graph:
    """Return the graph with factors for those measurements whose ends it has; starts only if it has the frame."""
    starts, distances = _usable(graph, measurements)
    if not starts and not distances:
        return graph
    places = [start.placement for start in starts]
    firsts: dict[str | TagKey, int] = dict(zip(_names(graph), graph.first_pose.tolist(), strict=True))
    tags: dict[str | TagKey, int] = _first_instances(graph)
    ends = [[distance.a for distance in distances], [distance.b for distance in distances]]
    (pose_a, pose_b), (tag_a, tag_b) = (
        [np.array([index.get(end, -1) for end in side], dtype=np.int64) for side in ends] for index in (firsts, tags)
    )
    measured = Priors(
        StartFactors(
            pose=np.array([firsts[start.run] for start in starts], dtype=np.int64),
            T_map_start=np.array([place.T_a_b for place in places]).reshape(-1, 3),
            whitening=whitening(np.array([place.covariance for place in places]).reshape(-1, 3, 3)),
        ),
        DistanceFactors(
            pose_a=pose_a,
            tag_a=tag_a,
            pose_b=pose_b,
            tag_b=tag_b,
            distance_m=np.array([distance.distance_m for distance in distances]),
            sigma_m=np.array([distance.sigma_m for distance in distances]),
        ),
    )
    return replace(graph, problem=replace(graph.problem, measured=measured))


def compare_measurements(
    graph: Graph, solution: Solution | CornerSolution, measurements: Measurements, component: int
) -> list[MeasurementResult]:
    """Return results of the measurements that a component uses, each tested against all else."""
    starts, distances = _usable(graph, measurements)
    measured, state = graph.problem.measured, solution.state
    by_start, by_distance = measured.linearise(state, solution.problem.columns)
    in_map = state.poses[measured.starts.pose], _lengths(measured.distances, state)
    given = _measured_values(measurements.frame, starts, distances)
    rows = [(by_start, m) for m in range(len(starts))] + [(by_distance, m) for m in range(len(distances))]
    results = []
    for result, (kind, m), value in zip(given, rows, [*in_map[0], *in_map[1]], strict=True):
        off_sigmas, bound = _deviation(kind, m, solution)
        results.append(
            replace(
                result,
                component=component,
                in_map=value,
                residual_sigmas=float(np.linalg.norm(kind.residual[m])),
                off_sigmas=off_sigmas,
                contradicts=off_sigmas is not None and off_sigmas > bound,
            )
        )
    return results


def compare_distances(
    graph: Graph, solution: Solution | CornerSolution, measurements: Measurements, misfit: Misfit | None
) -> list[tuple[MeasuredDistance, MeasurementResult]]:
    """Return the distances between ends of a component that was solved without them, compared with it.

    Args:
        graph: graph of the component.
        solution: solution of that graph, without the distances.
        measurements: measurements with the distances.
        misfit: misfit of the component, which increases its variances.
    """
    measurements = replace(measurements, starts=())
    _, distances = _usable(graph, measurements)
    factors = with_measurements(graph, measurements).problem.measured.distances
    linearised = factors.linearise(solution.state, solution.problem.columns)
    given = _measured_values(measurements.frame, (), distances)
    results = []
    for m, length_m in enumerate(_lengths(factors, solution.state)):
        columns, jacobian = _row(linearised, m)
        variance = (jacobian @ solution.covariance(columns) @ jacobian.T).item()  # of the map's, in the tape's sigmas
        variance *= 1.0 if misfit is None else misfit.variance_factor
        residual = float(np.abs(linearised.residual[m]).item())
        off_sigmas = residual / (1.0 + variance) ** 0.5
        result = replace(given[m], in_map=length_m, residual_sigmas=residual, off_sigmas=off_sigmas)
        results.append((distances[m], result))
    return results


def unused_measurements(measurements: Measurements, used: Sequence[MeasurementResult]) -> list[MeasurementResult]:
    """Return the measurements whose ends lie in different components.

    Args:
        measurements: all but those that were set aside.
        used: results of those that a component uses.
    """
    known = {(result.kind, result.a, result.b) for result in used}
    given = _measured_values(measurements.frame, measurements.starts, measurements.distances)
    return [result for result in given if (result.kind, result.a, result.b) not in known]


def measurement_warnings(results: Sequence[MeasurementResult]) -> list[str]:
    """Return warnings about measurements that contradict the map, and about unused ones."""
    warnings = []
    for result in results:
        option = f"--{result.kind} {result.b if result.kind == 'start' else f'{result.a},{result.b}'}"
        if result.in_map is None:
            warnings.append(f"{option}: not used, since its ends are in different components of the map")
        elif result.component is None and result.off_sigmas is not None:
            apart_m = float(np.abs(result.measured - result.in_map).item())
            warnings.append(
                f"{option}: measured {_figures(result.measured)}, but the map made without it has "
                f"{_figures(result.in_map)}, off by {result.off_sigmas:.1f} sigma (of both together: "
                f"{apart_m / result.off_sigmas:.2g} m), so it is not used; check its number, unit and ends; if it is "
                "right, robot.yaml is wrong about wheels and tags: give larger sigmas with --robot"
            )
        elif result.contradicts:
            warnings.append(
                f"{option}: measured {_figures(result.measured)}, which contradicts everything else by "
                f"{result.off_sigmas:.1f} sigma (the map, a compromise of both, has {_figures(result.in_map)}); "
                "check the measurement and its sigmas, or the map's scale is wrong"
            )
    return warnings


def _usable(graph: Graph, measurements: Measurements) -> tuple[tuple[MeasuredStart, ...], tuple[MeasuredDistance, ...]]:
    names, known = _names(graph), {*_names(graph), *_first_instances(graph)}
    has_frame = names[0] == measurements.frame
    starts = tuple(start for start in measurements.starts if has_frame and start.run in names)
    return starts, tuple(each for each in measurements.distances if each.a in known and each.b in known)


def _first_instances(graph: Graph) -> dict[str | TagKey, int]:
    """Return the index of each tag id; of the first instance where it is in several places."""
    return {tag.whole: i for i, tag in reversed(list(enumerate(graph.tags)))}


def _names(graph: Graph) -> list[str]:
    """Return the names of the segments; the first of several of a run has the run's own."""
    return [segment.name for segment in graph.segments]


def _deviation(kind: Linearised, m: int, solution: Solution | CornerSolution) -> tuple[float | None, float]:
    """Return the deviation of a measurement from the prediction by all others, in sigmas, and its bound.

    With S = J H^-1 J^T, r^T (I - S)^-1 r is the squared Mahalanobis distance from a prediction without the measurement
    (Cook and Weisberg, "Residuals and influence in regression", 1982): chi-square.
    """
    columns, jacobian = _row(kind, m)
    residual = kind.residual[m]
    left = np.eye(len(residual)) - jacobian @ solution.covariance(columns) @ jacobian.T
    share, ways = np.linalg.eigh(left)
    checked = share > _CHECKED
    if not checked.any():
        return None, np.inf
    square = float(((ways.T @ residual)[checked] ** 2 / share[checked]).sum())
    return square**0.5, float(chdtri(int(checked.sum()), _FALSE_ALARM)) ** 0.5


def _row(kind: Linearised, m: int) -> tuple[IntArray, FloatArray]:
    """Return the columns (k,) of one measurement and its Jacobian (r, k)."""
    columns = np.concatenate([columns[m] for columns, _ in kind.blocks])
    return columns, np.concatenate([derivative[m] for _, derivative in kind.blocks], axis=1)


def _lengths(distances: DistanceFactors, state: State) -> FloatArray:
    """Return (D, 1) lengths in the map."""
    place_a, place_b = ends_of(distances, state)
    lengths: FloatArray = np.linalg.norm(place_b - place_a, axis=1)[:, None]
    return lengths


def _measured_values(
    frame: str, starts: Sequence[MeasuredStart], distances: Sequence[MeasuredDistance]
) -> list[MeasurementResult]:
    """Return the measurements as results without a map."""
    given = [MeasurementResult("start", frame, each.run, each.T_map_start, each.sigma, None) for each in starts]
    for each in distances:
        a, b = (end if isinstance(end, str) else f"{end.family}:{end.tag_id}" for end in (each.a, each.b))
        given.append(MeasurementResult("distance", a, b, np.array([each.distance_m]), np.array([each.sigma_m]), None))
    return given


def _figures(values: FloatArray) -> str:
    if len(values) == 1:
        return f"{values[0]:.3f} m"
    return f"({values[0]:.3f}, {values[1]:.3f}) m, {values[2]:.4f} rad"
