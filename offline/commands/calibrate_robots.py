"""The `calibrate` command: drives in, robot.yaml out, with its parameters as estimated by the map of these drives."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from groundsbot.calib.camera import CameraModel, write_camera_yaml
from groundsbot.calib.robot import CameraFields, Robot, read_noise_yaml, write_robot_yaml
from groundsbot.offline.commands.arguments import logs_of, workers_for
from groundsbot.offline.commands.calibration_table import calibration_lines
from groundsbot.offline.commands.compilation import compile_solver
from groundsbot.offline.commands.progress_bar import progress_bar
from groundsbot.offline.commands.shared import echo_line, read_robot_files, scale_line
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
    correct_focal_lengths,
    correct_robot,
    parse_calibrate,
)

_YAML: Final = (".yaml", ".yml")


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of the command line."""

    logs: Sequence[Path]
    output: Path
    robots: Sequence[Path] = ()
    noise: Path | None = None
    distances: Sequence[str] = ()
    corners: bool = False
    calibrate: str = AUTO
    workers: int | None = None
    scheduler: str | None = None


@dataclass(frozen=True)
class CalibrationOutput:
    """The map of the drives, the parameters that were written, and the files."""

    result: MapResult
    estimates: tuple[CalibrationResult, ...]
    files: tuple[Path, ...]


def calibrate_robots(options: CalibrateOptions) -> CalibrationOutput:
    """Map the drives and write a file for each robot, and its camera's beside it.

    Raises:
        GroundsbotError: one line that says what is wrong; nothing is written then.
    """
    calibrate = parse_calibrate(options.calibrate)
    if not calibrate.is_on:
        raise OfflineError("--calibrate off: nothing would be estimated; give auto, or name the parameters to free")
    workings = Diagnostics()
    noise = read_noise_yaml(options.noise) if options.noise else None
    logs, robot_files = logs_of(options.logs), read_robot_files(options.robots)
    if options.output.exists():
        raise OfflineError(f"-o {options.output}: exists already and is not overwritten; name a new file or folder")
    shared = workers_for(logs, options.scheduler, options.workers)
    with announce_compilation(echo_line), progress_bar() as show, shared as workers:
        stages = Stages(show)
        runs = read_runs(logs, robot_files, stages, workers)
        compile_solver(stages)
        result = build_map(
            runs,
            noise,
            stages,
            TapeOptions((), options.distances),
            corners=options.corners,
            calibrate=calibrate,
            workings=workings,
            workers=workers,
        )
    robots = _robots(workings.runs)
    paths = _paths(options.output, [*robots])
    learnt = _most_certain(result.calibration)
    corrections = {OwnedParameter(each.owner, each.name): Correction(each.value, each.sigma) for each in learnt}
    outputs = [
        _output(correct_focal_lengths(run, corrections), correct_robot(run.robot, corrections), paths[robot_id])
        for robot_id, run in robots.items()
    ]
    written = [path for each in outputs for path in each.write()]
    return CalibrationOutput(result, tuple(learnt), tuple(written))


def summary(calibrated: CalibrationOutput) -> list[str]:
    """Return a table of what was estimated, and lines on what determines the scale, and the files."""
    result = calibrated.result
    lines = calibration_lines(calibrated.estimates, result.robot_numbers)
    lines += [scale_line(each, several=len(result.scale_budgets) > 1) for each in result.scale_budgets]
    lines += [f"warning: {warning}" for warning in result.warnings]
    lines += [f"lost: {loss}" for loss in result.losses]
    lines += [f"written: {path}" for path in calibrated.files]
    return [*lines, "use it for other drives: mapping these ones with it would count their measurements twice"]


def as_json(calibrated: CalibrationOutput) -> dict[str, Any]:
    """Return what was estimated, and why the rest was not."""
    words = {(each.owner, each.name): choice_words(each) for each in calibrated.result.choices}
    return {
        "learnt": [asdict(each) | {"choice": words.get((each.owner, each.name))} for each in calibrated.estimates],
        "choices": [asdict(each) for each in calibrated.result.choices],
        "metres": [asdict(each) for each in calibrated.result.scale_budgets],
        "warnings": list(calibrated.result.warnings),
        "losses": list(calibrated.result.losses),
        "files": [str(path) for path in calibrated.files],
    }


def _robots(runs: Sequence[Run]) -> dict[str, Run]:
    """Return a run of each robot, whose runs must all begin from the same parameters."""
    found: dict[str, Run] = {}
    for run in sorted(runs, key=lambda each: each.name):
        first = found.setdefault(run.robot_id, run)
        if _numbers(run) != _numbers(first):
            raise OfflineError(
                f"{run.log}: its robot.yaml or camera differs from that in {first.log}; give one to start from for "
                f"both, --robot FILE with robot_id {run.robot_id}"
            )
    return found


def _numbers(run: Run) -> tuple[object, ...]:
    robot = run.robot
    of_cameras = [
        (each.mount, each.time_offset_s, each.time_offset_s_sigma, each.edge_shift_px, each.edge_shift_px_sigma)
        for each in map(robot.with_camera, robot.camera_names)
    ]
    return robot.wheels, robot.tags, robot.camera_names, of_cameras, run.camera, run.named_cameras


def _most_certain(calibration: Sequence[CalibrationResult]) -> list[CalibrationResult]:
    """Return each parameter once: from the component with the smallest sigma."""
    best: dict[OwnedParameter, CalibrationResult] = {}
    for each in calibration:
        key = OwnedParameter(each.owner, each.name)
        if key not in best or each.sigma < best[key].sigma:
            best[key] = each
    return list(best.values())


def _paths(output: Path, robot_ids: Sequence[str]) -> dict[str, Path]:
    """Return the path of each robot's file."""
    if output.suffix not in _YAML:
        return {robot_id: output / f"{robot_id}.yaml" for robot_id in robot_ids}
    if len(robot_ids) > 1:
        raise OfflineError(
            f"-o {output}: the logs are of several robots ({', '.join(robot_ids)}), and each gets its own file; name a "
            "folder"
        )
    return {robot_ids[0]: output}


@dataclass(frozen=True)
class _RobotOutput:
    """A robot's file with those of its cameras, by path."""

    robot: Robot
    path: Path
    cameras: dict[Path, CameraModel]

    def write(self) -> list[Path]:
        """Write the cameras' files, then the robot's, so that a robot.yaml never names a missing camera."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            for path, model in self.cameras.items():
                write_camera_yaml(model, path)
            write_robot_yaml(self.robot, self.path)
        except OSError as error:
            what = "it or the camera file beside it" if self.cameras else "it"
            reason = f"{what} cannot be written ({error.strerror}); name a file that you may write"
            raise OfflineError(f"-o {self.path}: {reason}") from error
        return [self.path, *self.cameras]


def _output(run: Run, robot: Robot, path: Path) -> _RobotOutput:
    """Return what is written of a robot with the cameras of a run.

    Raises:
        OfflineError: one of several cameras has no calibration, or its file exists.
    """
    models = dict(run.named_cameras) if run.robot.cameras else {"": run.camera} if run.camera else {}
    for name in run.robot.cameras:
        if name not in models:
            raise OfflineError(
                f"{run.log}: no calibration of camera {name}; give the robot's file with --robot, with "
                f"cameras.{name}.camera set"
            )
    files = {name: path.with_name(f"{path.stem}_camera{name and f'_{name}'}.yaml") for name in models}
    for each in files.values():
        if each.exists():
            raise OfflineError(f"-o {path}: {each} exists already and is not overwritten; name another file")

    def of_camera(name: str, _fields: CameraFields) -> dict[str, object]:
        return {"camera": files[name].name if name in files else None}

    return _RobotOutput(robot.update_cameras(of_camera), path, {files[name]: each for name, each in models.items()})
