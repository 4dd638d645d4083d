"""The `map` command: logs in, a folder with the map out; written completely or not at all."""

import json
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from importlib.util import find_spec
from math import radians
from pathlib import Path
from typing import Final

from groundsbot.calib.foundation import EXIT_DONE, EXIT_WITH_LOSSES, folder_written_whole
from groundsbot.calib.robot import read_noise_yaml
from groundsbot.offline.commands.arguments import logs_of, workers_for
from groundsbot.offline.commands.compilation import compile_solver
from groundsbot.offline.commands.map_summary import OF_REPORT, REPORT_FILE
from groundsbot.offline.commands.progress_bar import progress_bar
from groundsbot.offline.commands.shared import check_output, echo_line, read_robot_files
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import StageCost, Stages, Workers, announce_compilation
from groundsbot.offline.mapping import Diagnostics, build_map, parse_frame, read_runs
from groundsbot.offline.maps import (
    JSON_FILE,
    MAP_FILE,
    MapResult,
    map_as_json,
    read_map,
    write_map,
    write_mcap,
)
from groundsbot.offline.measurements import Run, TapeOptions
from groundsbot.offline.self_calibration import AUTO, parse_calibrate

# Limits of --upright-deg: a smaller or larger sigma has the wrong unit.
_FINEST_DEG: Final = 0.01
_COARSEST_DEG: Final = 10.0
# Of more, sending the map to the processes that write it too takes as much memory as the map itself.
_MOST_KEYFRAMES_SENT: Final = 150_000


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
    scheduler: str | None = None


def make_map(options: MapOptions, workers: Workers | None = None) -> tuple[MapResult, tuple[StageCost, ...]]:
    """Map the logs and write map.json, map.npz, tags.csv, trajectories, map.mcap, map.png and report.html.

    Args:
        options: options of the command line.
        workers: those of these options, where they are started already.

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
    shared = workers_for(logs, options.scheduler, options.workers) if workers is None else nullcontext(workers)
    with announce_compilation(echo_line), progress_bar() as show, shared as workers:
        stages, workings = Stages(show), Diagnostics()

        def runs() -> list[Run]:
            read = read_runs(logs, robot_files, stages, workers)
            compile_solver(stages)
            return read

        result = build_map(
            runs(),  # not held here, since build_map drops their measurements
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
            _write_files(result, workings, folder, options.output, stages, workers)
    return result, stages.costs


def _write_files(
    result: MapResult, workings: Diagnostics, folder: Path, output: Path, stages: Stages, workers: Workers
) -> None:
    is_sent = sum(len(run.stamps_ns) for run in result.runs) <= _MOST_KEYFRAMES_SENT
    beside = workers if is_sent else Workers()
    try:
        with stages.stage("writing files"):
            messages = beside.begin_beside(_write_messages, (result, folder / MAP_FILE), MAP_FILE)
            drawn = replace(result, archived_segments=())  # most of the result, and not in the picture
            picture = beside.begin_beside(_draw_picture, (drawn, folder / "map.png"), "map.png")
            write_map(result, folder)
        if all(map(find_spec, OF_REPORT)):  # without these, only the report is missing
            from groundsbot.offline.report import write_report

            with stages.stage("writing the report"):
                write_report(result, workings, folder / REPORT_FILE)
        with stages.stage("drawing the picture"):
            picture()
        with stages.stage(f"writing {MAP_FILE}"):
            messages()
    except BaseException as error:
        workers.close(at_once=True)  # they write into the folder, which is removed now
        if isinstance(error, OSError):
            raise OfflineError(f"-o {output}: cannot be written ({error.strerror}); is the disk full?") from error
        raise


def _write_messages(what: tuple[MapResult, Path]) -> None:
    write_mcap(*what)


def _draw_picture(what: tuple[MapResult, Path]) -> None:
    from groundsbot.offline.report import write_picture  # takes 0.4 s to load

    write_picture(*what)


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


def as_json(result: MapResult, costs: Sequence[StageCost] | None = None) -> str:
    """Return the content of map.json, with the stages' costs if given."""
    data = map_as_json(result)
    if costs is not None:
        data["stages"] = [cost._asdict() for cost in costs]
    return json.dumps(data, indent=2, allow_nan=False)


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
