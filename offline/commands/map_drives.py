"""The `map` command: logs in, a folder with the map out; written completely or not at all."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from math import degrees, radians
from pathlib import Path
from typing import Final

from groundsbot.calib.foundation import EXIT_DONE, EXIT_WITH_LOSSES, folder_written_whole, plural
from groundsbot.calib.robot import read_noise_yaml
from groundsbot.offline.commands.arguments import logs_of
from groundsbot.offline.commands.progress_bar import progress_bar
from groundsbot.offline.commands.shared import check_output, echo_line, n_workers, read_robot_files, scale_line
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import StageCost, Stages, announce_compilation, worker_processes
from groundsbot.offline.mapping import Diagnostics, build_map, parse_frame, read_runs
from groundsbot.offline.maps import (
    JSON_FILE,
    MAP_FILE,
    NOT_NEEDED,
    AlignmentResult,
    Component,
    FittedNoise,
    MapResult,
    MeasurementResult,
    advice_as_json,
    map_as_json,
    read_map,
    write_map,
    write_mcap,
)
from groundsbot.offline.measurements import TapeOptions
from groundsbot.offline.report import (
    advice_sentence,
    contradiction_sentence,
    heading_sentence,
    headline,
    verdict_sentence,
    write_picture,
)
from groundsbot.offline.self_calibration import AUTO, parse_calibrate, refusal_lines, verdict_lines

REPORT_FILE: Final = "report.html"
_OF_REPORT: Final = ("plotly", "jinja2")
# Limits of --upright-deg: a smaller or larger sigma has the wrong unit.
_FINEST_DEG: Final = 0.01
_COARSEST_DEG: Final = 10.0
# On one screen.
_MOST_PAIRS: Final = 3
_MOST_ACTION_LINES: Final = 5


@dataclass(frozen=True)
class MapOptions:
    """Options of the command line."""

    logs: Sequence[Path]
    output: Path
    robots: Sequence[Path] = ()
    noise: Path | None = None
    overwrite: bool = False
    starts: Sequence[str] = ()
    distances: Sequence[str] = ()
    keep_suspects: bool = False
    corners: bool = False
    upright_deg: float | None = None
    extend: Path | None = None
    calibrate: str = AUTO
    frame: str = "start"
    workers: int | None = None


def make_map(options: MapOptions) -> tuple[MapResult, tuple[StageCost, ...]]:
    """Map the logs and write map.json, map.npz, tags.csv, trajectories, map.mcap, map.png and report.html.

    Returns:
        The map, and the cost of each stage.

    Raises:
        GroundsbotError: one line that says what is wrong; the output folder is then unchanged.
    """
    upright_sigma_rad = _upright_sigma_rad(options.upright_deg, corners=options.corners)
    logs = logs_of(options.logs)
    check_output(options.output, logs, JSON_FILE, overwrite=options.overwrite)
    extending = None if options.extend is None else _read_map_to_extend(options.extend, options)
    robot_files = read_robot_files(options.robots)
    noise = read_noise_yaml(options.noise) if options.noise else None
    calibrate = parse_calibrate(options.calibrate)
    frame = parse_frame(options.frame)
    count = n_workers(options.workers, logs)
    with announce_compilation(echo_line), progress_bar() as show, worker_processes(count) as workers:
        stages, workings = Stages(show), Diagnostics()
        result = build_map(
            read_runs(logs, robot_files, stages, workers),
            noise,
            stages,
            TapeOptions(options.starts, options.distances),
            keep_suspects=options.keep_suspects,
            corners=options.corners,
            upright_sigma_rad=upright_sigma_rad,
            calibrate=calibrate,
            frame=frame,
            workings=workings,
            extending=extending,
            workers=workers,
        )
        with folder_written_whole(options.output, replace=options.overwrite) as folder:
            _write_files(result, workings, folder, options.output, stages)
    return result, stages.costs


def _write_files(result: MapResult, workings: Diagnostics, folder: Path, output: Path, stages: Stages) -> None:
    try:
        with stages.stage("writing files"):
            write_map(result, folder)
            write_mcap(result, folder / MAP_FILE)
        with stages.stage("drawing the picture"):
            write_picture(result, folder / "map.png")
        if all(map(find_spec, _OF_REPORT)):  # without these, only the report is missing
            from groundsbot.offline.report import write_report

            with stages.stage("writing the report"):
                write_report(result, workings, folder / REPORT_FILE)
    except OSError as error:
        raise OfflineError(f"-o {output}: cannot be written ({error.strerror}); is the disk full?") from error


def _read_map_to_extend(path: Path, options: MapOptions) -> MapResult:
    """Read the map to extend: its folder, or map.json in it."""
    folder = path.parent if path.name == JSON_FILE else path
    check_output(options.output, [folder], JSON_FILE, overwrite=options.overwrite)
    if options.noise is not None:
        raise OfflineError("--noise: a map is extended with its own noise; leave it out, or map all logs anew")
    return read_map(folder)


def exit_code(result: MapResult) -> int:
    """Return the exit code: done; or done with several components, losses, contradictions, or no convergence."""
    is_doubtful = any(component.misfit or not component.converged for component in result.components)
    return EXIT_WITH_LOSSES if len(result.components) > 1 or result.losses or is_doubtful else EXIT_DONE


def summary(result: MapResult, output: Path, *, verbose: bool = False) -> list[str]:
    """Return lines for the terminal: the verdict, the result, what asks for action, and the files.

    Args:
        result: the map.
        output: its folder.
        verbose: also alignments, all distances between starts, noise and scale; and all that asks for action, otherwise
            its first five lines.
    """
    document = map_as_json(result)
    several = len(result.components) > 1
    told = (verdict_sentence(document), contradiction_sentence(document), headline(document))
    lines = [each for each in told if each]
    for number, component in enumerate(result.components, start=1):
        lines += _component_lines(component, number if several else None)
    pairs = [pair for component in result.components for pair in component.start_to_start]
    if verbose:
        lines += [_alignment_line(alignment) for alignment in result.alignments]
    lines += [
        f"start of {pair.a} to start of {pair.b}: {pair.distance_m:.3f} m (sigma {pair.sigma_m:.3f} m)"
        for pair in (pairs if verbose else pairs[:_MOST_PAIRS])
    ]
    lines += [
        _measurement_line(each, None if each.component is None else result.components[each.component].frame_run)
        for each in result.measurements
        if each.in_map is not None
    ]
    if verbose or result.measurements:  # shows the effect of measurements on the scale
        lines += [scale_line(each, several=len(result.scale_budgets) > 1) for each in result.scale_budgets]
    if verbose and result.noise_fit is not None:
        lines += _noise_lines(result.noise_fit)
    lines += _floor_lines(result)
    lines += [*verdict_lines(result.robot_numbers), *refusal_lines(result)]
    lines += _action_lines(result, verbose=verbose)
    return [*lines, f"map: {output / JSON_FILE}", f"picture: {output / 'map.png'}", _report_line(output)]


def _action_lines(result: MapResult, *, verbose: bool) -> list[str]:
    """Return losses, outliers and warnings, and what to drive next; the gravest first."""
    lines = [f"lost: {loss}" for loss in result.losses]
    lines += [f"suspect: {suspect.line()}" for suspect in result.outliers]
    lines += [f"warning: {warning}" for warning in result.warnings]
    lines += _advice_lines(result)
    if verbose or len(lines) <= _MOST_ACTION_LINES:
        return lines
    rest = len(lines) - _MOST_ACTION_LINES
    return [*lines[:_MOST_ACTION_LINES], f"{rest} more: in the report, or with -v"]


def _report_line(output: Path) -> str:
    path = output / REPORT_FILE
    without = f"report: none without {' and '.join(_OF_REPORT)}; pip install 'groundsbot[laptop]'"
    return f"report: {path}" if path.is_file() else without


def stage_lines(costs: Sequence[StageCost]) -> list[str]:
    """Return a table of the cost of each stage."""
    lines = [f"{'stage':<28}{'seconds':>8}{'of CPU':>8}{'peak MiB':>10}"]
    for name, seconds, cpu_seconds, peak_mib in costs:
        peak = "" if peak_mib is None else f"{peak_mib:10.0f}"
        lines.append(f"{name:<28}{seconds:8.2f}{cpu_seconds:8.2f}{peak}")
    return lines


def as_json(result: MapResult, costs: Sequence[StageCost] | None = None) -> str:
    """Return the content of map.json, with the stages' costs if given."""
    data = map_as_json(result)
    if costs is not None:
        data["stages"] = [cost._asdict() for cost in costs]
    return json.dumps(data, indent=2, allow_nan=False)


def _component_lines(component: Component, number: int | None) -> list[str]:
    """Return the runs of a component; its number is None if it is the only one."""
    lines = []
    if number is not None:
        tags = plural(len(component.tags), "tag")
        lines.append(f"component {number}, in the frame of {component.frame_owner}: {tags}")
    for run in component.runs:
        n_tags = sum(run.name in tag.runs for tag in component.tags)
        lines.append(
            f"{run.name}: {plural(run.n_keyframes, 'keyframe')}, {run.distance_m:.1f} m, {plural(n_tags, 'tag')}"
        )
    if number is None:
        frame = f"{component.frame_owner}'s start" if component.datum is None else component.frame_owner
        lines.append(f"{plural(len(component.tags), 'tag')} in one map, in the frame of {frame}")
    return lines


def _alignment_line(alignment: AlignmentResult) -> str:
    x_m, y_m, theta_rad = alignment.T_from_to
    weak = "; weak: it rests on one tag" if alignment.is_weak else ""
    return (
        f"alignment {alignment.from_run} <- {alignment.to_run}: {alignment.n_inliers} of {alignment.n_shared} shared "
        f"tags fit (RMS {alignment.inlier_rmse_m:.2f} m); "
        f"x {x_m:.2f} m, y {y_m:.2f} m, rotated {degrees(theta_rad):.1f} deg"
        + (weak if alignment.is_accepted else "; uncertain, so not used")
    )


def _measurement_line(measurement: MeasurementResult, frame_run: str | None) -> str:
    """Return an external measurement, and how it agrees with the map."""
    what = f"{measurement.a} to {measurement.b}" if measurement.kind == "distance" else f"start of {measurement.b}"
    if measurement.kind == "start" and frame_run != measurement.a:
        what += f" from that of {measurement.a}"
    values = [] if measurement.in_map is None else measurement.in_map.tolist()
    figures = f"{values[0]:.3f} m" if len(values) == 1 else "x {:.3f} m, y {:.3f} m, {:.4f} rad".format(*values)
    off = "nothing else determines it" if measurement.off_sigmas is None else f"off by {measurement.off_sigmas:.1f}"
    unit = "" if measurement.off_sigmas is None else " sigma"
    if measurement.component is None:
        return (
            f"measured {what}: {measurement.measured.item():.3f} m given, {figures} without it ({off}{unit}; not used)"
        )
    return f"measured {what}: {figures} in the map ({off}{unit})"


def _noise_lines(fit: FittedNoise) -> list[str]:
    """Return what was fitted, with its 99 % interval, and what was not."""
    fitted = [
        f"{each.name} {each.value:.3g} ({each.low:.3g} to {each.high:.3g})" for each in fit.parameters if not each.kept
    ]
    lines = []
    if fitted:
        lines.append(f"noise fitted to {plural(len(fit.runs), 'run')} (99 % interval): " + ", ".join(fitted))
    kept: dict[str, list[str]] = {}
    for each in fit.parameters:
        if each.kept not in ("", NOT_NEEDED):
            kept.setdefault(each.kept, []).append(f"{each.name} {each.value:.3g}")
    lines += [f"noise not fitted, since {why}: " + ", ".join(names) for why, names in kept.items()]
    return lines


def _floor_lines(result: MapResult) -> list[str]:
    """Return how uneven the floor is, if corners were used."""
    several = len(result.components) > 1
    lines = []
    for i, floor in enumerate(component.floor for component in result.components):
        if floor is not None and (floor.sigma_tilt_rad or floor.sigma_height_m):
            lines.append(
                f"floor{f' of component {i + 1}' if several else ''}: roll and pitch vary by "
                f"{degrees(floor.sigma_tilt_rad):.2f} deg and the height by {1000.0 * floor.sigma_height_m:.1f} mm "
                "(standard deviations)"
            )
    return lines


def _advice_lines(result: MapResult) -> list[str]:
    """Return the best advice for the worst tag, and for the heading; components must be merged first."""
    several = len({tag.family for component in result.components for tag in component.tags}) > 1
    if len(result.components) > 1:
        return []
    told = [advice_sentence(advice_as_json(each), several_families=several) for each in result.advice[:1]]
    return [f"advice: {sentence}" for sentence in [*told, heading_sentence(map_as_json(result))] if sentence]


def _upright_sigma_rad(upright_deg: float | None, *, corners: bool) -> float | None:
    """Return the sigma in rad of an option in degrees.

    Raises:
        OfflineError: one line that says what is wrong and what to write.
    """
    if upright_deg is None:
        return None
    if not corners:
        raise OfflineError(
            "--upright-deg: only corners determine the tilt of tags, which are assumed upright otherwise; give "
            "--model corners too, or leave it out"
        )
    if not _FINEST_DEG <= upright_deg <= _COARSEST_DEG:
        raise OfflineError(
            f"--upright-deg: the sigma is {upright_deg:g} deg, must be from {_FINEST_DEG:g} to {_COARSEST_DEG:g}"
        )
    return radians(upright_deg)
