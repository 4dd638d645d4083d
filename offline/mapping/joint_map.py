"""The map by the joint estimate (`estimate`): its components, and what the estimate says of tags, robots and scale."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import degrees
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import TAG_SCALE, NoiseParameters
from groundsbot.offline.advice import advise
from groundsbot.offline.alignment import Group, reason_not_joined
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.estimate import (
    DISTANCE,
    NU,
    RANGE_SCALE,
    RATIO,
    TURN_LEFT,
    TURN_RIGHT,
    Estimate,
    Joint,
    Owned,
    estimate_jointly,
    find,
)
from groundsbot.offline.estimate import FitFindings as JointFindings
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.global_map import edges_of, unused_measurements, weak_constraint_warnings
from groundsbot.offline.local_map import GoodnessOfFit, LocalMap, archive_map
from groundsbot.offline.mapping.frame import FrameChoice, in_frame
from groundsbot.offline.mapping.joint_segments import Names, corrected_segments
from groundsbot.offline.mapping.warnings import segment_warnings
from groundsbot.offline.mapping.workings import Diagnostics, SolvedGroup
from groundsbot.offline.maps import (
    AlignmentResult,
    ArchivedCalibration,
    CalibrationResult,
    Component,
    CrossCovariances,
    FittedNoise,
    FittedParameter,
    MapResult,
    MeasurementResult,
    OutlierTag,
    RunResult,
    ScaleBudget,
    TagResult,
    nominal_row,
    start_vectors,
)
from groundsbot.offline.measurements import ODOMETRY_NOISE, Measurements, Run, Segment, TagKey
from groundsbot.offline.sam import (
    PLAIN_SQUARES,
    CalibrationPrior,
    Graph,
    Parameter,
    Solution,
    State,
    build_graph,
    columns_of,
    mount_parameters_of,
    parameter_of_scale,
    parameters_of_camera,
    parameters_of_wheels,
    solve,
)
from groundsbot.offline.self_calibration import compare_with_files

_FITS: Final = GoodnessOfFit(0.0, 0, 0.0, 1.0, 1.0)
_CONTRADICTED: Final = 4.0  # sigmas
_SIGMAS_99: Final = 2.576
_INSTANCES: Final = "abcdefghijklmnopqrstuvwxyz"
_MOST_TOLD: Final = 3


class _Found(NamedTuple):
    """One component: the joint solve, its findings, the names of its places, and its least-squares problem."""

    joint: Joint
    findings: JointFindings
    names: Names
    graph: Graph
    solution: Solution


def map_jointly(
    runs: Sequence[Run],
    given: Sequence[Run],
    segments: Sequence[Segment],
    measurements: Measurements,
    prior_noise: NoiseParameters,
    stages: Stages,
    workers: Workers,
    frame: FrameChoice,
    workings: Diagnostics,
) -> MapResult:
    """Return the map of some runs by the joint estimate.

    Args:
        runs: runs without their measurements.
        given: the same, with the robots as their files have them.
        segments: all segments of the runs.
        measurements: distances by a person.
        prior_noise: noise before the drives are seen.
        stages: notified of progress.
        workers: that share the drives.
        frame: frame of the components.
        workings: filled with diagnostics.
    """
    est = estimate_jointly(segments, prior_noise, measurements.distances, stages, workers)
    found = [_solve_as_squares(joint) for joint in est.joints]
    components, calibration, taped, budgets, advice, unframed = [], [], [], [], [], []
    maps: dict[int, LocalMap] = {}
    for index, each in enumerate(found):
        with stages.stage("covariances"):
            component, own, cross = _component(each, index)
            framed = in_frame(component, frame, lambda cross=cross: cross)  # type: ignore[misc]
            components.append(replace(framed.component, edges=edges_of(each.graph, each.solution)))
            unframed += [framed.reason] if framed.reason else []
            calibration += own
            taped += _measurement_results(each.joint, measurements, index)
            budgets.append(_scale_budget(each.joint, index))
        with stages.stage("advice"):
            advice += advise(each.graph, each.solution, index)
        maps |= dict(zip(each.joint.members, _local_maps(each), strict=True))
        starts = each.solution.state.poses[each.graph.first_pose]
        group = SolvedGroup(
            Group(tuple(each.joint.members), starts), each.graph, each.solution, each.solution.state.poses
        )
        workings.components.append(group.move_to(framed.T_frame_start))
    _check_frame(unframed, components, frame)
    ordered = [maps[k] for k in sorted(maps)]
    workings.maps += ordered
    return MapResult(
        components=tuple(components),
        alignments=tuple(result for each in found for result in _alignments(each)),
        noise=_pooled_noise(found, prior_noise),
        calibration=tuple(calibration),
        robot_numbers=compare_with_files(given, calibration, ()),
        measurements=tuple(taped + unused_measurements(measurements, taped)),
        scale_budgets=tuple(budgets),
        warnings=tuple(dict.fromkeys(_warnings(runs, segments, est, found))),
        losses=tuple(f"{run.name}: mapped without what is lost of {run.log}: {run.lost}" for run in runs if run.lost),
        outliers=tuple(tag for each in found for tag in _outliers(each)),
        noise_fit=_noise_fit(found, segments),
        advice=tuple(advice),
        archived_segments=tuple(archive_map(each) for each in ordered),
    )


def _check_frame(reasons: Sequence[str], components: Sequence[Component], frame: FrameChoice) -> None:
    if reasons and len(reasons) == len(components):
        raise OfflineError(f"--frame {frame.text}: {reasons[0]}")


def _solve_as_squares(joint: Joint) -> _Found:
    findings = find(joint)
    names = _names(joint, findings)
    graph, solution = _least_squares(joint, corrected_segments(joint, names), names)
    return _Found(joint, findings, names, graph, solution)


def _names(joint: Joint, findings: JointFindings) -> Names:
    """Return the names of all places: a tag that some drives have elsewhere gets instances."""
    own = joint.problem.layout.own
    points = dict(zip(joint.tags, joint.problem.in_map.tolist(), strict=True))
    of_drive: dict[tuple[int, TagKey], TagKey] = {}
    for each in findings.elsewhere:
        first = each.tag._replace(instance="a")
        if each.tag in points:
            points[first] = points.pop(each.tag)
            of_drive |= {(place.drive, place.tag): first for place in own if place.tag == each.tag}
        used = sum(name.whole == each.tag.whole for name in points)
        name = each.tag._replace(instance=_INSTANCES[min(used, len(_INSTANCES) - 1)])
        points[name] = each.point
        of_drive |= {(drive, each.tag): name for drive in each.drives}
    return Names(of_drive, points)


def _least_squares(joint: Joint, segments: Sequence[Segment], names: Names) -> tuple[Graph, Solution]:
    """Return the least-squares problem of the last iteration with its calibration fixed, and its solution."""
    graph = build_graph(segments)
    n_free = np.zeros(len(graph.parameters), dtype=np.bool_)
    problem = replace(
        graph.problem,
        columns=columns_of(len(graph.problem.columns.poses), len(graph.tags), n_free),
        prior=CalibrationPrior(np.zeros(len(graph.parameters))),
    )
    graph = replace(graph, problem=problem)
    T = se2.inverse(joint.values.poses[joint.problem.layout.first_pose[0]])
    poses = joint.values.poses
    moved = np.column_stack([se2.apply(T, poses[:, :2]), poses[:, 2] + T[2]])
    tags = se2.apply(T, joint.values.points[[names.points[tag] for tag in graph.tags]].reshape(-1, 2))
    state = State(moved, np.asarray(tags).reshape(-1, 2), np.zeros(len(graph.parameters)))
    return graph, solve(problem, state, losses=PLAIN_SQUARES)


def _local_maps(found: _Found) -> list[LocalMap]:
    """Return each drive alone under the measurements and weights of the joint solve."""
    maps = []
    for k, segment in enumerate(found.graph.segments):
        graph = build_graph([segment])
        poses = found.graph.poses_of(found.solution.state, k)
        T = se2.inverse(poses[0])
        places = found.graph.tags_of(found.solution.state)
        own = np.array([places[tag] for tag in graph.tags]).reshape(-1, 2)
        turned = np.column_stack([se2.apply(T, poses[:, :2]), poses[:, 2] + T[2]])
        state = State(turned, np.asarray(se2.apply(T, own)).reshape(-1, 2), np.zeros(len(graph.parameters)))
        maps.append(LocalMap(segment, graph, solve(graph.problem, state), _FITS))
    return maps


def _component(found: _Found, index: int) -> tuple[Component, list[CalibrationResult], CrossCovariances]:
    """Return a component in the frame of its first start, its calibration, and what a change of frame needs."""
    joint, graph = found.joint, found.graph
    first = joint.problem.layout.first_pose[:-1]
    names = list(graph.tags)
    points = np.array([found.names.points[tag] for tag in names], dtype=np.int64)
    parameters = np.arange(1, len(joint.problem.calibration.names))
    held = joint.covariance(first, points, parameters)
    G = _to_first_start(joint.values.poses[first], joint.values.points[points])
    n = len(G)
    G = np.block([[G, np.zeros((n, len(parameters)))], [np.zeros((len(parameters), n)), np.eye(len(parameters))]])
    whole = G @ held @ G.T
    joint_covariance = whole[:n, :n]
    T = se2.inverse(joint.values.poses[first[0]])
    tags_m = np.asarray(se2.apply(T, joint.values.points[points].reshape(-1, 2))).reshape(-1, 2)
    poses = joint.values.poses
    moved = np.column_stack([se2.apply(T, poses[:, :2]), se2.wrap_angle(poses[:, 2] + T[2])])
    runs = tuple(_run(joint, graph.segments[k], moved, k, joint_covariance) for k in range(len(first)))
    n_starts = 3 * len(first)
    n_observations = graph.n_observations()
    tags = []
    for i, tag in enumerate(names):
        at = slice(n_starts + 2 * i, n_starts + 2 * i + 2)
        seen_by = [segment for segment in graph.segments if tag in segment.tags]
        robot = seen_by[0].run.robot
        has_size = any(batch.family == tag.family for batch in robot.tags)
        tags.append(
            TagResult(
                *tag, robot.tag_size_m(tag.family, tag.tag_id)[0] if has_size else None, tags_m[i],
                joint_covariance[at, at].copy(), int(n_observations[i]), tuple(each.name for each in seen_by),
            )
        )  # fmt: skip
    numbers = _numbers(joint)
    rows = np.array([each.row for each in numbers]).reshape(len(numbers), len(parameters))
    of_calibration = rows @ whole[n:, n:] @ rows.T
    with_places = rows @ whole[n:, :n]
    values = np.array([each.value for each in numbers])
    listed = [each.parameter for each in numbers]
    archived = ArchivedCalibration(
        owners=tuple(each.owner for each in listed),
        names=tuple(each.name for each in listed),
        nominal=np.array([nominal_row(each.nominal) for each in listed]).reshape(-1, len(nominal_row(()))),
        values=values,
        covariance=of_calibration,
        with_tags=with_places[:, n_starts:],
    )
    sigmas = np.sqrt(np.maximum(np.diag(of_calibration), 0.0)).tolist()
    results = [
        CalibrationResult(each.owner, each.name, index, value, sigma, each.sigma)
        for each, value, sigma in zip(listed, values.tolist(), sigmas, strict=True)
    ]
    component = Component(
        frame_run=graph.segments[0].name,
        runs=runs,
        tags=tuple(tags),
        joint_covariance=joint_covariance,
        cost=found.solution.cost,
        n_residuals=graph.problem.n_residuals,
        start_to_start=start_vectors(runs, joint_covariance),
        converged=joint.converged,
        calibration=archived,
    )
    return component, results, CrossCovariances(with_places[:, :n_starts], None)


def _to_first_start(starts: FloatArray, points: FloatArray) -> FloatArray:
    """Return the Jacobian of starts (R, 3) and points (T, 2), as seen from the first start, by them all.

    Both sides have the starts as (x, y, theta) first, then the points as (x, y).
    """
    n_starts, n = 3 * len(starts), 3 * len(starts) + 2 * len(points)
    x, y, theta = starts[0].tolist()
    cos, sin = np.cos(theta), np.sin(theta)
    back = np.array([[cos, sin], [-sin, cos]])
    G = np.zeros((n, n))
    for begin, place in [
        *((3 * k, start[:2]) for k, start in enumerate(starts)),
        *((n_starts + 2 * i, point) for i, point in enumerate(points)),
    ]:
        at = slice(begin, begin + 2)
        G[at, at] += back
        G[at, :2] -= back
        dx, dy = place - [x, y]
        G[at, 2] += back @ np.array([dy, -dx])
    for k in range(len(starts)):
        G[3 * k + 2, 3 * k + 2] += 1.0
        G[3 * k + 2, 2] -= 1.0
    return G


def _run(joint: Joint, segment: Segment, poses: FloatArray, k: int, covariance: FloatArray) -> RunResult:
    own = slice(*joint.problem.layout.first_pose[k : k + 2].tolist())
    at = slice(3 * k, 3 * k + 3)
    return RunResult(
        name=segment.name,
        run=segment.run.name,
        log=segment.run.log,
        robot_id=segment.run.robot_id,
        run_id=segment.run.run_id,
        T_map_start=poses[own][0],
        covariance=covariance[at, at].copy(),
        stamps_ns=segment.stamps_ns,
        T_map_base=poses[own],
        distance_m=float(segment.along_m[-1]),
    )


class _Number(NamedTuple):
    """A number of a robot's file: its correction, and the correction's row (C - 1,) by the calibration."""

    parameter: Parameter
    value: float
    row: FloatArray


def _numbers(joint: Joint) -> list[_Number]:
    """Return each number of robots' files that the estimate has."""
    found: dict[tuple[str, str], _Number] = {}
    for drive in joint.problem.drives:
        robot = drive.segment.run.robot
        distance, left, right, ratio = (
            Owned(robot.robot_id, name) for name in (DISTANCE, TURN_LEFT, TURN_RIGHT, RATIO)
        )
        of_scale, of_ratio, of_track = parameters_of_wheels(robot)
        own = [
            _number(joint, of_scale, {distance: 1.0}, is_logarithm=True),
            _number(joint, of_ratio, {ratio: 1.0}),
            _number(joint, of_track, {distance: 1.0, left: -0.5, right: -0.5}, is_logarithm=True),
        ]
        for camera in robot.camera_names:
            for each in (*mount_parameters_of(robot, camera), *parameters_of_camera(robot, camera)):
                own.append(_number(joint, each, {Owned(each.owner, each.name): 1.0}))
        scale = Owned(robot.robot_id, RANGE_SCALE)
        for tag in drive.segment.tags:
            each = parameter_of_scale(robot, tag)
            own.append(_number(joint, each, {Owned(each.owner, each.name): 1.0, scale: -1.0}, is_logarithm=True))
        for number in own:
            if number.row.any():
                found.setdefault((number.parameter.owner, number.parameter.name), number)
    return list(found.values())


def _number(joint: Joint, parameter: Parameter, terms: Mapping[Owned, float], *, is_logarithm: bool = False) -> _Number:
    calibration = joint.problem.calibration
    value, row = 0.0, np.zeros(len(calibration.names) - 1)
    for name, coefficient in terms.items():
        if index := calibration.index(name):
            value += coefficient * float(joint.values.calibration[index])
            row[index - 1] += coefficient
    return (
        _Number(parameter, float(np.expm1(value)), np.exp(value) * row)
        if is_logarithm
        else _Number(parameter, value, row)
    )


def _measurement_results(joint: Joint, measurements: Measurements, index: int) -> list[MeasurementResult]:
    """Return the distances by a person that a component used, each against the map without it."""
    known = {each.segment.name for each in joint.problem.drives} | set(joint.tags)
    used = [each for each in measurements.distances if {each.a, each.b} <= known]
    if not used:
        return []
    e, J = joint.problem.tape.linearise(joint.values)
    columns = joint.factor.order.kinds[5].columns
    results = []
    for m, distance in enumerate(used):
        leverage = float(J[m] @ joint.factor.covariance(columns[m]) @ J[m])
        weight = (NU + 1.0) ** 2 / (NU + 3.0) / (NU + float(e[m]) ** 2)  # as in the information
        off = abs(float(e[m])) / max(1.0 - weight * leverage, 1e-6) ** 0.5
        length_m = distance.distance_m + float(e[m]) * distance.sigma_m
        results.append(
            MeasurementResult(
                kind="distance", a=_end(distance.a), b=_end(distance.b), measured=np.array([distance.distance_m]),
                sigma=np.array([distance.sigma_m]), component=index, in_map=np.array([length_m]),
                residual_sigmas=abs(float(e[m])), off_sigmas=off, contradicts=off > _CONTRADICTED,
            )
        )  # fmt: skip
    return results


def _end(end: str | TagKey) -> str:
    return end if isinstance(end, str) else f"{end.family}:{end.tag_id}{end.instance}"


def _scale_budget(joint: Joint, index: int) -> ScaleBudget:
    """Return the sigma of the component's scale, that of its tags' extent, and what determines it."""
    points = joint.problem.in_map
    sigma = float("inf")
    if len(points) >= 2:
        none = np.zeros(0, dtype=np.int64)
        away = joint.tags_m - joint.tags_m.mean(axis=0)
        length = float(np.linalg.norm(away))
        if length > 0.0:
            way = away.reshape(-1) / length
            sigma = float(np.sqrt(way @ joint.covariance(none, points, none) @ way)) / length
    shares = dict.fromkeys(("wheels", "track", "tags", "mount", "distances", "starts"), 0.0)
    for prior in joint.problem.calibration.priors:
        name = prior.terms[0][0].name
        kind = "wheels" if name == DISTANCE and len(prior.terms) == 1 else "tags" if name == TAG_SCALE else None
        if kind is not None:
            shares[kind] += prior.sigma**-2
    tape = joint.problem.tape
    shares["distances"] = float(((tape.distance_m / tape.sigma_m) ** 2).sum())
    total = sum(shares.values())
    return ScaleBudget(index, sigma, {kind: value / total if total else 0.0 for kind, value in shares.items()})


def _alignments(found: _Found) -> list[AlignmentResult]:
    """Return where the starts of the other drives of a component are from the first one's, and how their tags agree."""
    joint = found.joint
    layout, points = joint.problem.layout, joint.values.points
    elsewhere = {(drive, each.tag) for each in found.findings.elsewhere for drive in each.drives}
    own = {(each.drive, each.tag): i for i, each in enumerate(layout.own)}
    starts = joint.values.poses[layout.first_pose[:-1]]
    names = [each.segment.name for each in joint.problem.drives]
    results = []
    for k in range(1, len(names)):
        shared = sorted(tag for drive, tag in own if drive == 0 and (k, tag) in own)
        apart = [tag for tag in shared if ((0, tag) in elsewhere) != ((k, tag) in elsewhere)]
        off = [points[own[0, tag]] - points[own[k, tag]] for tag in shared if tag not in apart]
        rmse_m = float(np.sqrt(np.mean(np.square(off)) * 2.0)) if off else 0.0
        results.append(
            AlignmentResult(
                names[0], names[k], se2.between(starts[0], starts[k]), len(shared), len(shared) - len(apart), rmse_m,
                tuple((tag.family, tag.tag_id) for tag in apart),
            )
        )  # fmt: skip
    return results


def _outliers(found: _Found) -> list[OutlierTag]:
    """Return the tags that some drives have elsewhere."""
    drives = [each.segment.name for each in found.joint.problem.drives]
    elsewhere = found.findings.elsewhere
    results = []
    for each in elsewhere:
        runs = tuple(drives[k] for k in each.drives)
        told = f"{each.off_m:.2f} m ({each.sigmas:.0f} sigma) elsewhere in {', '.join(runs)}"
        other = each.instead_of
        swapped = other is not None and any(
            back.tag == other and back.instead_of == each.tag and set(back.drives) & set(each.drives)
            for back in elsewhere
        )
        kind = "swapped" if swapped else "moved"
        evidence = f"{told}, where tag {other.tag_id} is otherwise" if swapped and other is not None else told
        swapped_with = other.tag_id if swapped and other is not None else None
        results.append(OutlierTag(each.tag.family, each.tag.tag_id, kind, runs, evidence, swapped_with))
    return results


def _warnings(runs: Sequence[Run], segments: Sequence[Segment], est: Estimate, found: Sequence[_Found]) -> list[str]:
    told = [w for run in runs for w in run.warnings] + [w for segment in segments for w in segment.warnings]
    told += segment_warnings(segments)
    for each in found:
        told += _about_readings(each) + _about_motions(each) + weak_constraint_warnings(each.graph, each.solution)
    for number, each in enumerate(found[1:], start=2):
        told.append(f"component {number}: {_why_not_joined(each, found)}")
    for index, each in enumerate(found):
        if not each.joint.converged:
            told.append(f"component {index + 1}: the solve did not converge; do not trust this map")
    return told


def _why_not_joined(own: _Found, found: Sequence[_Found]) -> str:
    """Return why a component is apart, for the pair of drives with most tags in common."""
    name = own.joint.problem.drives[0].segment.name
    pairs = []
    for drive in own.joint.problem.drives:
        if not drive.segment.tags:
            return f"{name} saw no tag, so nothing connects it to the other runs; it is a separate trajectory"
        for other in found:
            for beside in other.joint.problem.drives if other is not own else ():
                shared = sorted(set(drive.segment.tags) & set(beside.segment.tags))
                pairs.append((len(shared), beside.segment.name, drive.segment.name, shared))
    n, a, b, shared = max(pairs)
    if not n:
        return f"{name} shares no tag with the others; drive it past two tags that another run saw"
    return reason_not_joined(a, b, shared, None)


def _about_readings(found: _Found) -> list[str]:
    told = []
    drives = [each.segment.name for each in found.joint.problem.drives]
    misread = [each for each in found.findings.misread if each.really is not None]
    if misread:
        n = sum(each.n_readings for each in misread)
        some = ", ".join(
            f"{plural(each.n_readings, 'reading')} of {each.really.tag_id} as {each.tag.tag_id} in {drives[each.drive]}"
            for each in sorted(misread, key=lambda each: -each.n_readings)[:_MOST_TOLD]
            if each.really is not None
        )
        told.append(f"{plural(n, 'reading')} have the id of another tag than the one that stands there: {some}")
    stray = [each for each in found.findings.misread if each.really is None]
    if stray:
        n = sum(each.n_readings for each in stray)
        ids = ", ".join(str(tag_id) for tag_id in sorted({each.tag.tag_id for each in stray}))
        told.append(
            f"{len(stray)} {'pass' if len(stray) == 1 else 'passes'} ({plural(n, 'reading')}) of tags {ids} are far "
            "from where all others have the tag and count for nothing"
        )
    return told


def _about_motions(found: _Found) -> list[str]:
    told = []
    drives = found.joint.problem.drives
    for k, drive in enumerate(drives):
        free = sorted(
            (each for each in found.findings.free_motions if each.drive == k),
            key=lambda each: -(each.off_m + abs(each.off_rad)),
        )
        if free:
            begin_ns = int(drive.segment.stamps_ns[0])
            some = "; ".join(
                f"{each.off_m:.2f} m and {degrees(each.off_rad):+.0f} deg at {(each.stamp_ns - begin_ns) * 1e-9:.0f} s"
                for each in free[:_MOST_TOLD]
            )
            told.append(
                f"{drive.segment.name}: {plural(len(free), 'motion')} that the wheels do not tell (lifted, pushed or "
                f"slipped), estimated from tags: {some}"
            )
    return told


def _pooled_noise(found: Sequence[_Found], prior: NoiseParameters) -> NoiseParameters:
    """Return the noise of all robots: geometric means over the drives."""
    values = {name: np.exp(np.mean(np.log(each))) for name, each in _scales(found).items()}
    return prior.model_copy(update={name: float(np.clip(value, 1e-9, 1e3)) for name, value in values.items()})


def _scales(found: Sequence[_Found]) -> dict[str, list[float]]:
    scales: dict[str, list[float]] = {}
    for each in found:
        for noise in each.joint.problem.noises:
            own = dict(zip(ODOMETRY_NOISE, noise.motion.tolist(), strict=True)) | noise.reading
            for name, value in own.items():
                if name in NoiseParameters.model_fields:
                    scales.setdefault(name, []).append(value)
    return scales


def _noise_fit(found: Sequence[_Found], segments: Sequence[Segment]) -> FittedNoise:
    counts: dict[str, float] = {}
    for each in found:
        for own in each.joint.counts:
            for name, count in own.items():
                counts[name] = counts.get(name, 0.0) + count
    rows = []
    for name, values in _scales(found).items():
        value, count = float(np.exp(np.mean(np.log(values)))), counts.get(name, 0.0)
        factor = float(np.exp(_SIGMAS_99 / np.sqrt(2.0 * max(count, 1.0))))
        rows.append(FittedParameter(name, value, value / factor, value * factor, count))
    return FittedNoise(tuple(rows), 0.0, 0.0, 0.0, 0.0, tuple(each.name for each in segments), ())
