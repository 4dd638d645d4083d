"""The mapping pipeline: runs -> segments -> local maps -> alignments -> components -> one joint solve each."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from groundsbot.calib.robot import WHEEL_PARAMETERS, NoiseParameters
from groundsbot.offline.alignment import Merge, merge
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.global_map import (
    SolvedComponent,
    TagJoin,
    join_over_tags,
    join_results,
    join_warnings,
    solve_group,
    unused_measurements,
)
from groundsbot.offline.importing import placeholder_parameters
from groundsbot.offline.local_map import (
    LocalMap,
    archive_map,
    archived_tag_ids,
    restore_local_map,
    tape_options_of,
    with_adjacent_arrays,
)
from groundsbot.offline.mapping.earlier import EarlierMap
from groundsbot.offline.mapping.findings import Findings
from groundsbot.offline.mapping.frame import FrameChoice
from groundsbot.offline.mapping.inputs import check_distinct, check_new, check_tag_sizes
from groundsbot.offline.mapping.joint_map import map_jointly
from groundsbot.offline.mapping.measured_distances import set_aside_distances
from groundsbot.offline.mapping.merge_report import alignment_results
from groundsbot.offline.mapping.warnings import map_warnings
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps import MapResult, MeasurementResult
from groundsbot.offline.measurements import (
    Measurements,
    Run,
    Segment,
    TapeOptions,
    most_times,
    parse_measurements,
    segments_of,
)
from groundsbot.offline.noise import fit_noise_of, with_noise_of_map
from groundsbot.offline.outliers import (
    local_maps_of,
    remove_outliers_under_own_noise,
    split_duplicates,
    with_outliers_apart,
)
from groundsbot.offline.self_calibration import (
    N_MAPPINGS,
    Calibrate,
    FreedRobots,
    applied_corrections,
    check_wiring,
    compare_with_files,
    free_as_before,
    free_parameters,
    initialise_open_robots,
    relative_to_files,
)


def build_map(
    runs: Sequence[Run],
    noise: NoiseParameters | None = None,
    stages: Stages | None = None,
    tape: TapeOptions | None = None,
    prior_noise: NoiseParameters = NoiseParameters(),
    *,
    keep_suspects: bool = False,
    corners: bool = False,
    upright_sigma_rad: float | None = None,
    calibrate: Calibrate = Calibrate(is_on=True),
    frame: FrameChoice = FrameChoice(),
    workings: Diagnostics | None = None,
    extending: MapResult | None = None,
    workers: Workers | None = None,
    earlier: EarlierMap | None = None,
) -> MapResult:
    """Turn runs into one map.

    Args:
        runs: runs from `load_run`.
        noise: sigmas of wheels and tag observations; None: they are fitted to the runs.
        stages: notified of progress, and records times.
        tape: measurements by a person.
        prior_noise: initial value of the fit, and prior where the runs contain no information.
        keep_suspects: only name outlier tags, without splitting them off.
        corners: refine the solved map on the tags' corners, where logs have them.
        upright_sigma_rad: sigma of the tags' tilt where they are known to be upright, used with corners; None: any
            tilt.
        calibrate: which parameters of robot.yaml the drives may correct.
        frame: frame of the map; without another choice the first run's start.
        workings: filled with diagnostics of the map.
        extending: an archived map, whose runs come first, and under whose noise all is solved.
        workers: processes that share the drives; None: this process. The result does not depend on them.
        earlier: what was estimated from earlier parts of the same drives, and is not estimated again.

    Raises:
        GroundsbotError: one line that says why there can be no map.
    """
    stages, tape, workers = stages or Stages(), tape or TapeOptions(), workers or Workers()
    check_distinct(runs)
    check_tag_sizes(runs)
    noise_fit = None
    if earlier is None:
        check_wiring(runs, stages, workers)
    else:
        noise, noise_fit = earlier.noise, earlier.noise_fit
    if extending is not None:
        check_new(runs, extending, noise, corners=corners, calibrate=calibrate)
        calibrate = Calibrate()  # an archived map has its calibration
        noise, noise_fit, tape = extending.noise, extending.noise_fit, tape_options_of(extending, tape)
    frame.check_run(_run_names(runs, extending))
    workings = workings or Diagnostics()
    given = [each.without_measurements() for each in runs]
    workings.runs += given
    is_free = noise is None and earlier is None and extending is None and calibrate == Calibrate(is_on=True)
    if is_free and not (corners or keep_suspects or workings.keeps_corners or tape.starts) and _has_joint_model(runs):
        return _map_jointly(runs, given, tape, prior_noise, stages, workers, frame, workings)
    if earlier is None:
        freed = _calibrate_runs(runs, noise or prior_noise, stages, workers, calibrate, extending, corners=corners)
    else:
        freed = free_as_before(runs, earlier.freed)
    segments = _segments(freed.runs, noise or prior_noise, stages, workers)
    runs = [each.without_measurements() for each in freed.runs]
    freed = workings.freed = freed._replace(runs=runs)
    measurements = _measurements(tape, runs, segments, extending)
    known = _maps_to_extend(extending, stages)
    times = N_MAPPINGS if calibrate.is_on else 1
    is_fitted = noise is None or (earlier is not None and noise_fit is not None)
    starts = freed.starts if earlier is None else {name: each.as_start for name, each in earlier.local_maps.items()}
    fitted = None
    maps, noisy, broken = local_maps_of(
        segments, stages, times, noise_is_open=is_fitted, workers=workers, starts=starts
    )
    if noise is None:
        with stages.stage("fitting the noise"):
            fitted = fit_noise_of(maps, prior_noise, workers)
        noise, noise_fit = fitted.noise, fitted.fitted
    else:
        maps = known + with_noise_of_map(maps, noise, noise_fit)
    if is_fitted:
        maps, slipped = remove_outliers_under_own_noise(maps, noisy, stages, workers, fitted)
        broken += slipped
    maps = [each.without_systems() for each in maps]
    if not (corners or workings.keeps_corners):
        maps = [each.with_fixed_noise(most_times(len(maps))) for each in maps]
    maps = with_adjacent_arrays(maps)
    kept = tuple(archive_map(each) for each in maps)
    solve = partial(
        _align_and_solve,
        stages=stages,
        workers=workers,
        keep_suspects=keep_suspects,
        corners=corners,
        upright_sigma_rad=upright_sigma_rad,
    )
    (maps, merged, components, joins), measurements, set_aside = _solve_with_distances(maps, measurements, solve)
    joined = join_results(components, joins)
    found = Findings(frame=frame)
    while components:  # each is freed once it is reported: its factor on corners may take 100 MiB
        workings.components.append(found.add(maps, components.pop(0), measurements, stages))
    workings.maps += maps
    found.check_frame()
    found.measurements += set_aside + unused_measurements(measurements, found.measurements)
    found.warnings += join_warnings(joins, joined)
    runs = [*{each.segment.run.name: each.segment.run for each in known}.values(), *runs]
    calibration = relative_to_files(found.calibration, freed.applied)
    return MapResult(
        components=tuple(found.components),
        alignments=alignment_results(maps, merged) + joined,
        noise=noise,
        calibration=tuple(calibration),
        robot_numbers=compare_with_files(given, calibration, freed.choices),
        measurements=tuple(found.measurements),
        checks=tuple(found.checks),
        scale_budgets=tuple(found.scale_budgets),
        warnings=map_warnings(
            runs, maps, broken, merged, found, [each for each in joins if each.reason] if corners else None
        ),
        losses=tuple(f"{run.name}: mapped without what is lost of {run.log}: {run.lost}" for run in runs if run.lost),
        outliers=tuple(found.outliers),
        noise_fit=noise_fit,
        advice=tuple(found.advice),
        choices=freed.choices,
        archived_segments=kept,
    )


def _has_joint_model(runs: Sequence[Run]) -> bool:
    """Return whether the joint estimate has a term for all measurements of the runs, of robots that nobody measured.

    Robots of a file, or with the track given to `import`, go the other way as long as their maps were not compared.
    """
    track = WHEEL_PARAMETERS[-1]
    return any(len(run.positions.tag) for run in runs) and all(
        run.robot.is_left_open
        and track in placeholder_parameters(run.robot)
        and run.gyro is None
        and len(run.robot.camera_names) == 1
        and not len(run.detections.tag)
        for run in runs
    )


def _map_jointly(
    runs: Sequence[Run],
    given: Sequence[Run],
    tape: TapeOptions,
    prior_noise: NoiseParameters,
    stages: Stages,
    workers: Workers,
    frame: FrameChoice,
    workings: Diagnostics,
) -> MapResult:
    segments = _segments(runs, prior_noise, stages, workers)
    measurements = _measurements(tape, runs, segments, None)
    bare = [each.without_measurements() for each in runs]
    return map_jointly(bare, given, segments, measurements, prior_noise, stages, workers, frame, workings)


def _calibrate_runs(
    runs: Sequence[Run],
    noise: NoiseParameters,
    stages: Stages,
    workers: Workers,
    calibrate: Calibrate,
    extending: MapResult | None,
    *,
    corners: bool,
) -> FreedRobots:
    """Return the runs with start values and freed parameters."""
    runs, started, searches, starts = initialise_open_robots(runs, noise, stages, workers, extending)
    found = FreedRobots(runs, started, applied_corrections(started), searches, {}, starts)
    if calibrate.is_on:
        freed = free_parameters(runs, noise, calibrate.names, stages, workers, corners=corners)
        found = freed._replace(
            choices=(*started, *freed.choices),
            applied=found.applied | freed.applied,
            searches=searches | freed.searches,
            starts=starts,
        )
    return found


def _segments(runs: Sequence[Run], noise: NoiseParameters, stages: Stages, workers: Workers) -> list[Segment]:
    """Return all segments of the runs, with two tags of the same id split."""
    items, names = [(run, noise) for run in runs], [run.name for run in runs]
    found = workers.map(_segments_of_run, items, names, stages, "keyframes and observations")
    return [segment for own in found for segment in own]


def _segments_of_run(item: tuple[Run, NoiseParameters], _stages: Stages) -> list[Segment]:
    found = [split_duplicates(segment) for segment in segments_of(*item)]
    run = item[0].without_detections()
    return [replace(segment, run=run) for segment in found]


def _measurements(
    tape: TapeOptions, runs: Sequence[Run], segments: Sequence[Segment], extending: MapResult | None
) -> Measurements:
    names, tags = _run_names(runs, extending), {tag for segment in segments for tag in segment.tags}
    if extending is not None:
        tags |= {tag for each in extending.archived_segments for tag in archived_tag_ids(each)}
    return parse_measurements(tape, names, sorted(tags))


def _run_names(runs: Sequence[Run], extending: MapResult | None) -> list[str]:
    """Return the names of all runs, those of the map that is extended first."""
    known = () if extending is None else extending.archived_segments
    return [*dict.fromkeys(each.run for each in known), *(run.name for run in runs)]


def _maps_to_extend(extending: MapResult | None, stages: Stages) -> list[LocalMap]:
    """Return the local maps of a map that is extended, under the noise they were archived with."""
    if extending is None:
        return []
    with stages.stage("the map that is extended"):
        return [restore_local_map(each) for each in extending.archived_segments]


class _SolvedTogether(NamedTuple):
    """Local maps, their merge and solved components, and the single tags that were tried to join components."""

    maps: list[LocalMap]  # with tags split that are elsewhere in other maps
    merged: Merge
    components: list[SolvedComponent]
    joins: list[TagJoin]


def _solve_with_distances(
    maps: Sequence[LocalMap],
    measurements: Measurements,
    solve: Callable[[Sequence[LocalMap], Measurements], _SolvedTogether],
) -> tuple[_SolvedTogether, Measurements, list[MeasurementResult]]:
    """Solve without the measured distances that the map made without any contradicts.

    Returns:
        The solved components, the measurements that they use, and those that were set aside.
    """
    if not measurements.distances:
        return solve(maps, measurements), measurements, []
    without = solve(maps, replace(measurements, distances=()))
    measurements, set_aside = set_aside_distances(without.maps, without.components, measurements)
    return solve(maps, measurements) if measurements.distances else without, measurements, set_aside


def _align_and_solve(
    maps: Sequence[LocalMap],
    measurements: Measurements,
    stages: Stages,
    workers: Workers,
    *,
    keep_suspects: bool,
    corners: bool,
    upright_sigma_rad: float | None,
) -> _SolvedTogether:
    """Align local maps and solve each group; on corners a single tag may join two groups."""
    placements = measurements.placements([each.segment.name for each in maps])
    merged = merge(maps, placements, stages=stages, workers=workers)
    with stages.stage("aligning local maps"):
        maps = with_outliers_apart(maps, merged)
    solve = partial(solve_group, keep_suspects=keep_suspects, corners=corners, upright_sigma_rad=upright_sigma_rad)
    components = [solve(maps, members, measurements, stages, workers) for members in merged.groups]
    joins: list[TagJoin] = []
    if corners and len(components) > 1:
        components, joins = join_over_tags(maps, merged, components, measurements, stages, upright_sigma_rad)
        merged = replace(merged, groups=tuple(each.members for each in components))
    return _SolvedTogether(maps, merged, components, joins)
