"""The `localize` command: logs and a map in, a folder with the trajectories out; written completely or not at all."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import degrees
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import EXIT_DONE, EXIT_WITH_LOSSES, atomic_write, folder_written_whole, plural
from groundsbot.calib.robot import NoiseParameters, read_noise_yaml
from groundsbot.offline.commands.arguments import logs_of, workers_for
from groundsbot.offline.commands.compilation import compile_solver
from groundsbot.offline.commands.progress_bar import progress_bar
from groundsbot.offline.commands.shared import check_output, echo_line, read_robot_files
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, announce_compilation
from groundsbot.offline.localization import Candidate, Localization, LocatedRun, NotLocated, localize
from groundsbot.offline.mapping import check_distinct, read_runs
from groundsbot.offline.maps import MapResult, read_map, write_tum
from groundsbot.offline.measurements import Run, TagKey

FORMAT_VERSION: Final = 1
JSON_FILE: Final = "localization.json"
TRAJECTORY_COLUMNS: Final = (
    "t_ns",
    "x_m",
    "y_m",
    "theta_rad",
    "covariance_xx_m2",
    "covariance_xy_m2",
    "covariance_yy_m2",
    "covariance_xtheta_m_rad",
    "covariance_ytheta_m_rad",
    "covariance_thetatheta_rad2",
)
_ROWS, _COLUMNS = (0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)


@dataclass(frozen=True)
class LocalizeOptions:
    """Options of the command line."""

    logs: Sequence[Path]
    map: Path
    output: Path | None = None
    robots: Sequence[Path] = ()
    noise: Path | None = None
    component: int | None = None
    overwrite: bool = False
    workers: int | None = None


def localize_logs(options: LocalizeOptions) -> dict[str, Localization]:
    """Localise each log alone in a map, and write the trajectories if an output is given.

    Returns:
        The results by the names of the runs, in the order of the logs.

    Raises:
        GroundsbotError: one line that says what is wrong; nothing is written then.
    """
    logs = logs_of(options.logs)
    known = read_map(options.map)
    if options.output is not None:
        check_output(options.output, [*logs, options.map], JSON_FILE, overwrite=options.overwrite)
    robot_files = read_robot_files(options.robots)
    noise = read_noise_yaml(options.noise) if options.noise else None
    known = replace(known, archived_segments=())  # most of a map, and only for its extension
    with (
        announce_compilation(echo_line),
        progress_bar() as show,
        workers_for(logs, None, options.workers) as workers,
    ):
        stages = Stages(show)
        runs = read_runs(logs, robot_files, stages, workers)
        check_distinct(runs)
        compile_solver(stages)
        names = [run.name for run in runs]
        items = (_DriveInMap(run, known, options.map, noise, options.component) for run in runs)
        found = dict(zip(names, workers.map(_localize_drive, items, names, stages, "localising drives"), strict=True))
    if options.output is not None:
        _write(found, options.output, overwrite=options.overwrite)
    return found


class _DriveInMap(NamedTuple):
    """A run, the map and its folder, and how to localise the run in it."""

    run: Run
    known: MapResult
    folder: Path
    noise: NoiseParameters | None
    component: int | None


def _localize_drive(drive: _DriveInMap, stages: Stages) -> Localization:
    return localize(drive.run, drive.known, drive.folder, noise=drive.noise, component=drive.component, stages=stages)


def _write(found: dict[str, Localization], output: Path, *, overwrite: bool) -> None:
    try:
        with folder_written_whole(output, replace=overwrite) as folder:
            text = json.dumps(as_json(found), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
            with atomic_write(folder / JSON_FILE) as partial:
                partial.write_text(text, encoding="utf-8")
            for run in (run for each in found.values() for run in each.runs):
                write_tum(folder / f"{run.name}.tum", run.stamps_ns, run.T_map_base)
                with atomic_write(folder / f"{run.name}.csv") as partial:
                    partial.write_text(trajectory_csv(run), encoding="ascii")
    except OSError as error:
        raise OfflineError(f"-o {output}: cannot be written ({error.strerror}); is the disk full?") from error


def trajectory_csv(run: LocatedRun) -> str:
    """Return a row for each keyframe."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(TRAJECTORY_COLUMNS)
    covariances = run.covariance[:, _ROWS, _COLUMNS]
    for stamp, pose, covariance in zip(
        run.stamps_ns.tolist(), run.T_map_base.tolist(), covariances.tolist(), strict=True
    ):
        writer.writerow([stamp, *(f"{value:.9f}" for value in pose), *(f"{value:.9g}" for value in covariance)])
    return stream.getvalue()


def as_json(found: dict[str, Localization]) -> dict[str, Any]:
    """Return the content of localization.json: plain data of one drive, or of each of several."""
    drives = [_localization_json(each) for each in found.values()]
    if len(drives) == 1:
        return {"format_version": FORMAT_VERSION} | drives[0]
    named = [{"drive": name} | each for name, each in zip(found, drives, strict=True)]
    return {"format_version": FORMAT_VERSION, "drives": named}


def _localization_json(found: Localization) -> dict[str, Any]:
    return {
        "map": str(found.map),
        "component": found.component,
        "frame_run": found.frame_run,
        "located": found.is_located,
        "runs": [_run_json(run) for run in found.runs],
        "not_located": [
            {"run": each.name, "reason": each.reason, "candidates": [_candidate_json(c) for c in each.candidates]}
            for each in found.not_located
        ],
        "moved_tags": [
            _tag_json(each.tag)
            | {
                "run": each.run,
                "position_m": each.position_m.tolist(),
                "shift_m": each.shift_m,
                "sigmas": each.sigmas,
            }
            for each in found.moved
        ],
        "new_tags": [{"family": tag.family, "tag_id": tag.tag_id} for tag in found.new],
        "warnings": list(found.warnings),
        "losses": list(found.losses),
    }


def _run_json(run: LocatedRun) -> dict[str, Any]:
    return {
        "run": run.name,
        "stretch_of": None if run.name == run.run else run.run,
        "T_map_start": run.T_map_base[0].tolist(),
        "covariance": run.covariance[0].tolist(),
        "T_map_end": run.T_map_base[-1].tolist(),
        "end_covariance": run.covariance[-1].tolist(),
        "n_keyframes": len(run.stamps_ns),
        "distance_m": run.distance_m,
        "tags": [_tag_json(tag) for tag in run.tags],
    }


def _candidate_json(candidate: Candidate) -> dict[str, Any]:
    return {
        "component": candidate.component,
        "T_map_start": candidate.T_map_start.tolist(),
        "tags": [_tag_json(tag) for tag in candidate.tags],
    }


def _tag_json(tag: TagKey) -> dict[str, Any]:
    return {"family": tag.family, "tag_id": tag.tag_id, "instance": tag.instance}


def exit_code(found: dict[str, Localization]) -> int:
    """Return the exit code: done; or with segments that are not located, losses of a log, or no convergence."""
    is_doubtful = any(each.not_located or each.losses or not each.converged for each in found.values())
    return EXIT_WITH_LOSSES if is_doubtful else EXIT_DONE


def summary(found: dict[str, Localization], output: Path | None) -> list[str]:
    """Return the results as lines of text."""
    lines = [line for each in found.values() for line in _drive_lines(each)]
    if output is not None:
        lines.append(f"{'trajectory' if len(found) == 1 else 'trajectories'}: {output}")
    return lines


def _drive_lines(found: Localization) -> list[str]:
    lines = [line for run in found.runs for line in _run_lines(run)]
    lines += [line for each in found.not_located for line in _not_located_lines(each)]
    lines += [each.line() for each in found.moved]
    if found.new:
        ids = ", ".join(str(tag.tag_id) for tag in found.new)
        lines.append(f"not in the map, so used for the motion only: tag{'s' if len(found.new) > 1 else ''} {ids}")
    lines += [f"warning: {warning}" for warning in found.warnings]
    return [*lines, *(f"lost: {loss}" for loss in found.losses)]


def _run_lines(run: LocatedRun) -> list[str]:
    n = plural(len(run.tags), "tag")
    return [
        f"{run.name}: {plural(len(run.stamps_ns), 'keyframe')}, {run.distance_m:.1f} m, localised by {n} of the map",
        f"  start {_pose_text(run, 0)}",
        f"  end   {_pose_text(run, -1)}",
    ]


def _pose_text(run: LocatedRun, at: int) -> str:
    x_m, y_m, theta_rad = run.T_map_base[at]
    sigma_x_m, sigma_y_m, sigma_rad = np.sqrt(np.diag(run.covariance[at]))
    return (
        f"x {x_m:.3f} m, y {y_m:.3f} m, {degrees(theta_rad):.2f} deg "
        f"(sigma {sigma_x_m:.3f} m, {sigma_y_m:.3f} m, {degrees(sigma_rad):.2f} deg)"
    )


def _not_located_lines(each: NotLocated) -> list[str]:
    lines = [f"not located: {each.reason}"]
    for candidate in each.candidates:
        x_m, y_m, theta_rad = candidate.T_map_start
        lines.append(
            f"  perhaps started at x {x_m:.2f} m, y {y_m:.2f} m, {degrees(theta_rad):.1f} deg "
            f"(component {candidate.component + 1})"
        )
    return lines
