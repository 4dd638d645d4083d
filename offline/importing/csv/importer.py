"""A folder of CSV files -> a run log that `map` reads like a recorded one."""

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Final

from groundsbot.calib.foundation import StrPath, plural
from groundsbot.calib.tags import families, family_size
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.csv.forms import CsvObservation, read_gyro, read_observations, read_paper_landmarks
from groundsbot.offline.importing.csv.odometry import (
    OdometryPath,
    read_odometry,
    read_paper_odometry,
    refuse_tick_options,
)
from groundsbot.offline.importing.robot import (
    DETECTOR_SCALE_SIGMA,
    RANGE_SCALE_SIGMA,
    ImportOptions,
    RobotDefaults,
    describe_robot,
    safe_name,
    wheel_scale,
)
from groundsbot.offline.importing.run_writer import Entry, ImportReport, check_output, write_run
from groundsbot.onboard.log import Gyro, PlanarOdometry, RunInfo, TagObservation, TagObservations

_HEADER_PAIR: Final = ("odometry.csv", "observations.csv")
_PAPER_PAIR: Final = ("odom.csv", "landmarks.csv")
_GYRO: Final = "gyro.csv"  # beside either pair


@dataclass(frozen=True)
class _CsvDrive:
    """Content of one folder in any form."""

    wheels: OdometryPath
    n_odometry: int
    observations: list[CsvObservation]
    in_camera: bool
    range_scale_sigma: float
    remarks: list[str]
    gyro: list[tuple[int, float]]


def import_folder(folder: StrPath, output: StrPath, options: ImportOptions | None = None) -> ImportReport:
    """Write `output/<run_id>/0000.core.mcap` from a folder of CSV files; the same input gives the same bytes.

    All input is checked before anything is written, and the run folder appears complete or not at all.

    Raises:
        GroundsbotError: one line that names file, line, column, value and what to do.
    """
    folder, output, options = Path(folder), Path(output), options or ImportOptions()
    if not folder.is_dir():
        raise OfflineError(f"{folder}: is not a folder; give one with {_pair_names()}")
    run_id = options.run_id or safe_name(folder)
    run_folder = output / run_id
    check_output(output, run_folder)
    if options.tag_family not in families():
        raise OfflineError(f"--tag-family is {options.tag_family!r}, must be one of {', '.join(families())}")
    if options.out_of_plane_flags:
        flags = " and ".join(options.out_of_plane_flags)
        raise OfflineError(
            f"{folder}: observations in CSV files are planar (x, y on the floor), so {flags} would have no effect; "
            "leave them out"
        )
    drive = _read_drive(folder, options)
    known = RobotDefaults(
        needs_track=drive.wheels.needs_track,
        wheel_scale_sigma=drive.wheels.scale_sigma,
        range_scale_sigma=drive.range_scale_sigma,
    )
    robot, robot_yaml, robot_remarks = describe_robot(folder, options, drive.in_camera, known)
    info = RunInfo(
        run_id=run_id,
        robot_id=robot.robot_id,
        software_version=metadata.version("groundsbot"),
        robot_yaml=robot_yaml,
    )
    write_run(run_folder, {"/run": info}, _messages(drive, options.tag_family))
    return ImportReport(
        run_folder=run_folder,
        run_id=run_id,
        robot_id=robot.robot_id,
        n_odometry=drive.n_odometry,
        duration_s=(drive.wheels.stamps_ns[-1] - drive.wheels.stamps_ns[0]) * 1e-9,
        distance_m=drive.wheels.distance_m,
        n_observations=len(drive.observations),
        n_tags=len({observation.tag_id for observation in drive.observations}),
        remarks=(*drive.remarks, *robot_remarks),
    )


def _read_drive(folder: Path, options: ImportOptions) -> _CsvDrive:
    pairs = [pair for pair in (_HEADER_PAIR, _PAPER_PAIR) if any((folder / name).is_file() for name in pair)]
    if len(pairs) != 1:
        found = "both pairs of" if pairs else "none of the pairs"
        raise OfflineError(f"{folder}: holds {found} {_pair_names()}; give the folder of one drive, with one pair")
    for name, other in (pairs[0], pairs[0][::-1]):
        if not (folder / name).is_file():
            raise OfflineError(f"{folder / name}: is missing beside {other}; add it")
    drive = _paper_drive(folder, options) if pairs[0] == _PAPER_PAIR else _header_drive(folder, options)
    if (folder / _GYRO).is_file():
        drive.gyro.extend(read_gyro(folder / _GYRO))
        drive.remarks.append(f"{_GYRO}: {plural(len(drive.gyro), 'reading')} of the yaw rate")
    outside = _n_outside(drive)
    if outside and outside == len(drive.observations):
        raise OfflineError(
            f"{folder}: none of {plural(outside, 'observation')} lies within the odometry's time; "
            "are both files on one clock?"
        )
    if outside:
        drive.remarks.append(f"{plural(outside, 'observation')} outside the odometry's time, which maps leave out")
    return drive


def _header_drive(folder: Path, options: ImportOptions) -> _CsvDrive:
    if options.state_rate_hz is not None:
        raise OfflineError(f"{folder}: --state-rate-hz is for odom.csv; odometry.csv holds its own times, leave it out")
    wheels, form = read_odometry(folder / _HEADER_PAIR[0], wheel_scale(options), options.wheelbase_m)
    observations = read_observations(folder / _HEADER_PAIR[1], family_size(options.tag_family) - 1)
    in_camera = options.has_mount or options.robot is None
    where = "the frame of the camera (or other sensor)" if in_camera else "base (--robot without --camera options)"
    remarks = [f"odometry.csv: {form}", f"observations.csv: assumed to be in {where}, y to the left"]
    return _CsvDrive(wheels, len(wheels.stamps_ns), observations, in_camera, RANGE_SCALE_SIGMA, remarks, [])


def _paper_drive(folder: Path, options: ImportOptions) -> _CsvDrive:
    rate_hz = options.state_rate_hz
    if rate_hz is None:
        raise OfflineError(
            f"{folder / _PAPER_PAIR[0]}: holds no times; give --state-rate-hz (the paper's authors used 4.2)"
        )
    refuse_tick_options(folder / _PAPER_PAIR[0], options.tick_flags)
    if options.wheelbase_m is not None:
        raise OfflineError(
            f"{folder / _PAPER_PAIR[0]}: holds wheel speeds, so --wheelbase-m would have no effect; leave it out"
        )
    wheels = read_paper_odometry(folder / _PAPER_PAIR[0], rate_hz)
    n_states = len(wheels.stamps_ns) - 1
    observations = read_paper_landmarks(folder / _PAPER_PAIR[1], n_states, rate_hz, family_size(options.tag_family) - 1)
    remarks = [
        f"odom.csv: the paper's form, {rate_hz:g} states a second",
        "landmarks.csv: the paper's form, in the camera's frame, y converted from right to left",
    ]
    return _CsvDrive(wheels, n_states, observations, True, DETECTOR_SCALE_SIGMA, remarks, [])


def _n_outside(drive: _CsvDrive) -> int:
    first, last = drive.wheels.stamps_ns[0], drive.wheels.stamps_ns[-1]
    return sum(not first <= observation.stamp_ns <= last for observation in drive.observations)


def _messages(drive: _CsvDrive, family: str) -> Iterator[Entry]:
    """Yield (stamp, topic, message) in order of time, odometry first at equal times."""
    frame = "camera_planar" if drive.in_camera else "base"
    gyro = ((at, "/gyro", Gyro(stamp_ns=at, yaw_rate_rad_s=rate)) for at, rate in drive.gyro)
    observations = _observations(drive.observations, frame, family)
    return merge(_odometry(drive.wheels), gyro, observations, key=lambda each: each[0])


def _odometry(wheels: OdometryPath) -> Iterator[Entry]:
    if wheels.poses:
        for stamp_ns, (x_m, y_m, theta_rad) in zip(wheels.stamps_ns, wheels.poses, strict=True):
            pose = PlanarOdometry.PoseInOdom(x_m=x_m, y_m=y_m, theta_rad=theta_rad)
            yield stamp_ns, "/odometry", PlanarOdometry(stamp_ns=stamp_ns, pose=pose)
        return
    for stamp_ns, left_m, right_m in zip(wheels.stamps_ns, wheels.left_m, wheels.right_m, strict=True):
        distances = PlanarOdometry.WheelDistances(left_m=left_m, right_m=right_m)
        yield stamp_ns, "/odometry", PlanarOdometry(stamp_ns=stamp_ns, wheels=distances)


def _observations(observations: list[CsvObservation], frame: str, family: str) -> Iterator[Entry]:
    for stamp_ns, group in groupby(observations, key=lambda observation: observation.stamp_ns):
        tags = [_tag_observation(observation, family) for observation in group]
        yield stamp_ns, "/tags/observations", TagObservations(stamp_ns=stamp_ns, frame=frame, observations=tags)


def _tag_observation(observation: CsvObservation, family: str) -> TagObservation:
    message = TagObservation(family=family, tag_id=observation.tag_id)
    if observation.kind == "polar":
        message.polar.range_m, message.polar.bearing_rad = observation.first, observation.second
    else:
        message.cartesian.x_m, message.cartesian.y_m = observation.first, observation.second
    if observation.sigmas is not None:
        sigma_first, sigma_second = observation.sigmas
        message.covariance.extend([sigma_first**2, 0.0, 0.0, sigma_second**2])
    return message


def _pair_names() -> str:
    return f"{' + '.join(_HEADER_PAIR)} or {' + '.join(_PAPER_PAIR)}"
