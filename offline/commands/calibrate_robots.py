"""The `calibrate` command: drives in, robot.yaml out, with what the map of these drives made of its numbers."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from groundsbot.calib.camera import CameraModel, write_camera_yaml
from groundsbot.calib.robot import FOCAL_SCALE, Robot, read_noise_yaml, write_robot_yaml
from groundsbot.offline.commands.progress_bar import progress_bar
from groundsbot.offline.commands.shared import echo_line, metre_line, read_robot_files
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, announce_compilation
from groundsbot.offline.mapping import Diagnostics, build_map, read_runs
from groundsbot.offline.maps import CalibrationResult, MapResult
from groundsbot.offline.measurements import Run, TapeOptions
from groundsbot.offline.self_calibration import (
    AUTO,
    Correction,
    OwnedParameter,
    choice_words,
    correct_robot,
    correction_lines,
    parse_calibrate,
    with_focal_lengths,
)
from groundsbot.onboard.log import find_logs

_YAML: Final = (".yaml", ".yml")


@dataclass(frozen=True)
class CalibrateOptions:
    """What the command line says."""

    logs: Sequence[Path]
    output: Path
    robots: Sequence[Path] = ()
    noise: Path | None = None
    distances: Sequence[str] = ()
    corners: bool = False
    calibrate: str = AUTO


@dataclass(frozen=True)
class Calibrated:
    """The map that the drives gave, what of its calibration was written, and where."""

    result: MapResult
    learnt: tuple[CalibrationResult, ...]
    files: tuple[Path, ...]


def calibrate_robots(options: CalibrateOptions) -> Calibrated:
    """Maps the drives and writes a file for each robot, and its camera's beside it.

    Raises:
        GroundsbotError: one line that says what stands in the way; nothing is written then.
    """
    calibrate = parse_calibrate(options.calibrate)
    if not calibrate.is_on:
        raise OfflineError("--calibrate off: then there is nothing to learn; say auto, or name what is to be freed")
    workings = Diagnostics()
    noise = read_noise_yaml(options.noise) if options.noise else None
    logs, robot_files = find_logs(list(options.logs)), read_robot_files(options.robots)
    if options.output.exists():
        raise OfflineError(f"-o {options.output}: is there already; name a new file or folder, nothing is written over")
    with announce_compilation(echo_line), progress_bar() as show:
        stages = Stages(show)
        result = build_map(
            read_runs(logs, robot_files, stages),
            noise,
            stages,
            TapeOptions((), options.distances),
            corners=options.corners,
            calibrate=calibrate,
            workings=workings,
        )
    robots = _robots(workings.runs)
    paths = _paths(options.output, [*robots])
    learnt = _most_certain(result.calibration)
    corrections = {OwnedParameter(each.owner, each.name): Correction(each.value, each.sigma) for each in learnt}
    written = []
    for robot_id, run in robots.items():
        written += _write(correct_robot(run.robot, corrections), _camera(run, corrections), paths[robot_id])
    return Calibrated(result, tuple(learnt), tuple(written))


def summary(calibrated: Calibrated) -> list[str]:
    """What was learnt, what holds the scale, and where it is written."""
    result = calibrated.result
    lines = correction_lines(result, calibrated.learnt)
    lines += [metre_line(each, several=len(result.metres) > 1) for each in result.metres]
    lines += [f"warning: {warning}" for warning in result.warnings]
    lines += [f"lost: {loss}" for loss in result.losses]
    lines += [f"written: {path}" for path in calibrated.files]
    return [*lines, "for other drives: these ones would count twice, were they mapped with what they taught"]


def as_json(calibrated: Calibrated) -> dict[str, Any]:
    """What was learnt and why the rest was not."""
    words = {(each.owner, each.name): choice_words(each) for each in calibrated.result.choices}
    return {
        "learnt": [asdict(each) | {"choice": words.get((each.owner, each.name))} for each in calibrated.learnt],
        "choices": [asdict(each) for each in calibrated.result.choices],
        "metres": [asdict(each) for each in calibrated.result.metres],
        "warnings": list(calibrated.result.warnings),
        "losses": list(calibrated.result.losses),
        "files": [str(path) for path in calibrated.files],
    }


def _robots(runs: Sequence[Run]) -> dict[str, Run]:
    """A run of each robot, whose runs must all begin from the same numbers."""
    found: dict[str, Run] = {}
    for run in sorted(runs, key=lambda each: each.name):
        first = found.setdefault(run.robot_id, run)
        if _numbers(run) != _numbers(first):
            raise OfflineError(
                f"{run.log}: its robot.yaml or camera is another one than that in {first.log}; give the one that both "
                f"are to begin from, --robot FILE with robot_id {run.robot_id}"
            )
    return found


def _numbers(run: Run) -> tuple[object, ...]:
    robot = run.robot
    return (
        robot.wheels, robot.mount, robot.tags, robot.time_offset_s, robot.time_offset_s_sigma, robot.edge_shift_px,
        robot.edge_shift_px_sigma, run.camera,
    )  # fmt: skip


def _most_certain(calibration: Sequence[CalibrationResult]) -> list[CalibrationResult]:
    """Each number once: from the component that tells it best."""
    best: dict[OwnedParameter, CalibrationResult] = {}
    for each in calibration:
        key = OwnedParameter(each.owner, each.name)
        if key not in best or each.sigma < best[key].sigma:
            best[key] = each
    return list(best.values())


def _paths(output: Path, robot_ids: Sequence[str]) -> dict[str, Path]:
    """Where each robot's file goes."""
    if output.suffix not in _YAML:
        return {robot_id: output / f"{robot_id}.yaml" for robot_id in robot_ids}
    if len(robot_ids) > 1:
        raise OfflineError(
            f"-o {output}: the logs are of several robots ({', '.join(robot_ids)}), each gets a file of its own; name "
            "a folder"
        )
    return {robot_ids[0]: output}


def _camera(run: Run, learnt: dict[OwnedParameter, Correction]) -> CameraModel | None:
    return with_focal_lengths(run.camera, learnt.get(OwnedParameter(run.robot_id, FOCAL_SCALE)))


def _write(robot: Robot, camera: CameraModel | None, path: Path) -> list[Path]:
    """The robot's file, its camera's first: a robot.yaml that is there names a camera that is there."""
    camera_path = path.with_name(f"{path.stem}_camera.yaml")
    if camera is not None and camera_path.exists():
        raise OfflineError(f"-o {path}: {camera_path} is there already; name another file, nothing is written over")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if camera is None:
            write_robot_yaml(robot.model_copy(update={"camera": None}), path)
            return [path]
        write_camera_yaml(camera, camera_path)
        write_robot_yaml(robot.model_copy(update={"camera": camera_path.name}), path)
    except OSError as error:
        raise OfflineError(f"-o {path}: cannot be written ({error.strerror}); name a file you may write") from error
    return [path, camera_path]
