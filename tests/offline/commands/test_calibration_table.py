"""The table that `calibrate` prints."""

from typing import Any

from groundsbot.offline.commands.calibration_table import calibration_lines
from groundsbot.offline.maps.parameter_results import CalibrationResult, RobotNumber
from groundsbot.offline.self_calibration.robot_table import AGREES, NOT_OBSERVABLE, WRONG

DRIVE = "turn on the spot"
NUMBERS: list[tuple[Any, ...]] = [
    ("carl", "wheel_scale", "mean wheel radius (m)", 0.0825, 0.08333, 0.0002, WRONG, "write it", "m"),
    ("carl", "wheel_ratio", "wheel radius, right / left", 1.0, 0.9993, 0.0008, AGREES, ""),
    ("carl", "mount_x_m", "mount.x_m", 0.12, 0.1108, 0.009, NOT_OBSERVABLE, DRIVE, "m"),
    ("carl", "mount_yaw_rad", "mount.yaw_rad", 0.0, 0.0175, 0.0009, AGREES, "", "rad"),
    ("carl", "time_offset_s", "time_offset_s", 0.02, 0.0211, 0.001, NOT_OBSERVABLE, DRIVE, "s"),
    ("carl", "edge_shift_px", "edge_shift_px", 0.0, -0.06, 0.007, AGREES, "", "px"),
    ("default tag36h11", "tag_scale", "tag size (m)", 0.15, 0.1501, 0.0001, AGREES, "", "m"),
    ("mixed tag36h11", "tag_scale", "tag size, relative", 1.0, 1.002, 0.001, AGREES, ""),
]


def test_values_are_in_mm_degrees_and_per_cent_and_drives_come_once() -> None:
    rows = [RobotNumber(owner, name, 0, *rest) for owner, name, *rest in NUMBERS]
    elsewhere = RobotNumber("carl", "mount_x_m", 1, "mount.x_m", 0.12, 0.5, 0.3, AGREES, "", "m")
    estimates = [CalibrationResult(row.owner, row.name, 0, 0.0, 0.1, 0.1) for row in rows]
    assert calibration_lines(estimates, [*rows, elsewhere]) == [
        "of                parameter                   robot.yaml    found  sigma  unit",
        "carl              mean wheel radius                82.50    83.33   0.20    mm  robot.yaml is wrong",
        "carl              wheel radius, right / left     100.000   99.930  0.080     %  agrees",
        "carl              mount.x                         120.00   110.80   9.00    mm  not observable",
        "carl              mount.yaw                        0.000    1.003  0.052   deg  agrees",
        "carl              time_offset                      20.00    21.10   1.00    ms  not observable",
        "carl              edge_shift                       0.000   -0.060  0.007    px  agrees",
        "default tag36h11  tag size                        150.00   150.10   0.10    mm  agrees",
        "mixed tag36h11    tag size                       100.000  100.200  0.100     %  agrees",
        f"to determine mount.x (carl), time_offset (carl): {DRIVE}",
    ]
    assert calibration_lines([], rows) == []
