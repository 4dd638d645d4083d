"""The `localize` command: a log and a map in, a folder with the trajectory out; written completely or not at all."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import EXIT_DONE, EXIT_WITH_LOSSES, atomic_write, folder_written_whole, plural
from groundsbot.calib.robot import read_noise_yaml
from groundsbot.offline.commands.arguments import log_of
from groundsbot.offline.commands.compilation import compile_solver
from groundsbot.offline.commands.progress_bar import progress_bar
from groundsbot.offline.commands.shared import check_output, echo_line, read_robot_files
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, announce_compilation
from groundsbot.offline.localization import Candidate, Localization, LocatedRun, NotLocated, localize
from groundsbot.offline.mapping import check_robots
from groundsbot.offline.maps import read_map, write_tum
from groundsbot.offline.measurements import TagKey, load_run

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

    log: Path
    map: Path
    output: Path | None = None
    robots: Sequence[Path] = ()
    noise: Path | None = None
    component: int | None = None
    overwrite: bool = False


def localize_log(options: LocalizeOptions) -> Localization:
    """Localise one log in a map, and write its trajectory if an output is given.

    Raises:
        GroundsbotError: one line that says what is wrong; nothing is written then.
    """
    log = log_of(options.log)
    known = read_map(options.map)
    if options.output is not None:
        check_output(options.output, [log, options.map], JSON_FILE, overwrite=options.overwrite)
    robot_files = read_robot_files(options.robots)
    noise = read_noise_yaml(options.noise) if options.noise else None
    with announce_compilation(echo_line), progress_bar() as show:
        stages = Stages(show)
        compile_solver(stages)
        run = load_run(log, robot_files)
        check_robots([run], robot_files)
        found = localize(run, known, options.map, noise=noise, component=options.component, stages=stages)
    if options.output is not None:
        _write(found, options.output, overwrite=options.overwrite)
    return found


def _write(found: Localization, output: Path, *, overwrite: bool) -> None:
    try:
        with folder_written_whole(output, replace=overwrite) as folder:
            text = json.dumps(as_json(found), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
            with atomic_write(folder / JSON_FILE) as partial:
                partial.write_text(text, encoding="utf-8")
            for run in found.runs:
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


def as_json(found: Localization) -> dict[str, Any]:
    """Return the content of localization.json: plain data."""
    return {
        "format_version": FORMAT_VERSION,
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


def exit_code(found: Localization) -> int:
    """Return the exit code: done; or with segments that are not located, losses of the log, or no convergence."""
    return EXIT_WITH_LOSSES if found.not_located or found.losses or not found.converged else EXIT_DONE


def summary(found: Localization, output: Path | None) -> list[str]:
    """Return the result as lines of text."""
    lines = [line for run in found.runs for line in _run_lines(run)]
    lines += [line for each in found.not_located for line in _not_located_lines(each)]
    lines += [each.line() for each in found.moved]
    if found.new:
        ids = ", ".join(str(tag.tag_id) for tag in found.new)
        lines.append(f"not in the map, so used for the motion only: tag{'s' if len(found.new) > 1 else ''} {ids}")
    lines += [f"warning: {warning}" for warning in found.warnings]
    lines += [f"lost: {loss}" for loss in found.losses]
    if output is not None:
        lines.append(f"trajectory: {output}")
    return lines


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
