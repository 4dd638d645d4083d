"""A drive that determines most numbers of a robot, and its map with some of them wrong in the file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import RobotFile
from groundsbot.offline.self_calibration.option import Calibrate
from tests.support.data.drives import CAMERA, MadeTag, make_drive, make_robot, picture_stamps, write_drive

NOISE = NoiseParameters()
AUTO = Calibrate(is_on=True)
# To and fro in a room, with whole turns on the spot to either side.
LEGS = [(0.5, 0.52, 6.0), (-0.3, 0.3, 7.9), (0.5, 0.5, 6.0), (0.3, -0.3, 7.8)] * 2
TAGS = [
    MadeTag(3 * i + j, (x, y, 0.3 + 0.2 * j), yaw)
    for i, (x, y, yaw) in enumerate(
        [
            (7.0, 0.0, np.pi),
            (7.0, 3.0, np.pi),
            (-4.0, 0.5, 0.0),
            (-4.0, 3.0, 0.0),
            (2.0, -4.0, np.pi / 2),
            (2.0, 7.0, -np.pi / 2),
        ]
    )
    for j in range(2)
]


def drive_legs(folder: Path, name: str, legs: Sequence[tuple[float, float, float]]) -> Path:
    drive = make_drive([0.0, 0.0, 0.0], legs)
    pictures_ns = picture_stamps(drive, 3.7)
    return write_drive(folder, drive, TAGS, make_robot(name), corner_sigma_px=0.2, pictures_ns=pictures_ns)


def mistaken(**changes: float) -> Robot:
    """The robot's file with some numbers wrong: of wheels by a share, of the mount as they are."""
    robot = make_robot("a")
    wheels = {name: getattr(robot.wheels, name) * (1.0 + off) for name, off in changes.items() if "radius" in name}
    if "track_m" in changes:
        wheels["track_m"] = robot.wheels.track_m * (1.0 + changes["track_m"])
    mount = {name: getattr(robot.mount, name) + changes[name] for name in changes if hasattr(robot.mount, name)}
    return robot.model_copy(
        update={"wheels": robot.wheels.model_copy(update=wheels), "mount": robot.mount.model_copy(update=mount)}
    )


def map_runs(log: Path, robot: Robot, calibrate: Calibrate = AUTO, *, corners: bool = False) -> MapResult:
    files = {"a": RobotFile(robot, {"": CAMERA})}
    return build_map(read_runs([log], files), NOISE, corners=corners, calibrate=calibrate)
