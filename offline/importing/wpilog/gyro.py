"""A yaw, or a yaw rate, of a WPILib log -> the gyro readings of an imported log."""

import re
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import FloatArray, IntArray, plural
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.csv.forms import MAX_YAW_RATE_RAD_S
from groundsbot.offline.importing.run_writer import Entry
from groundsbot.offline.importing.wpilog.held import hold_between
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic
from groundsbot.offline.importing.wpilog.structs import is_array, read_numbers, struct_name
from groundsbot.onboard.log import Gyro

_ROTATIONS: Final = ("Rotation2d", "Rotation3d")
_LIMELIGHT: Final = "robot_orientation_set"  # what the robot sends to its Limelight: yaw in degrees, and five others
_RATE: Final = re.compile(r"per.?s|rate|velocity|omega", re.IGNORECASE)
_DEGREES: Final = re.compile(r"deg", re.IGNORECASE)
_RADIANS: Final = re.compile(r"rad", re.IGNORECASE)
_LIKELY: Final = re.compile(r"gyro|yaw|pigeon|navx|imu|robot_orientation_set", re.IGNORECASE)
_UNLIKELY: Final = re.compile(r"target|photonvision|reset|setpoint", re.IGNORECASE)  # of cameras, or wanted
_MOST_NAMED: Final = 4


def is_gyro(topic: WpiTopic) -> bool:
    """Whether a topic can hold a yaw."""
    rotation = struct_name(topic) in _ROTATIONS and not is_array(topic)
    return rotation or topic.type == "double" or (topic.type == "double[]" and topic.last == _LIMELIGHT)


def likely_gyros(log: WpiLog) -> list[str]:
    """Return names of topics that seem to hold a yaw, at most a few."""
    found = [each.name for each in log.topics if is_gyro(each) and each.n_records > 1]
    return [name for name in found if _LIKELY.search(name) and not _UNLIKELY.search(name)][:_MOST_NAMED]


def gyro_entries(log: WpiLog, topic: WpiTopic) -> tuple[list[Entry], str]:
    """Return (stamp, topic, message) of the yaw rate, positive to the left, and a remark.

    A yaw's rate is the mean between two records, and stamped midway.

    Raises:
        OfflineError: its unit is unknown, a record is damaged, or a rate is one that no robot has.
    """
    stamps_ns, values = read_numbers(log, topic)
    where, is_rate = f"{log.path}: {topic.name}", topic.type == "double" and _RATE.search(topic.last) is not None
    if len(stamps_ns) < 2:
        raise OfflineError(f"{where}: has one record; give a topic that holds a yaw all along")
    angles = _radians(where, topic, values)
    stamps_ns, filled = hold_between(stamps_ns, angles[:, None])
    rates = filled[:, 0]
    if not is_rate:
        turned = (np.diff(rates) + np.pi) % (2.0 * np.pi) - np.pi
        steps_ns = np.diff(stamps_ns)
        rates, stamps_ns = turned / (steps_ns * 1e-9), stamps_ns[:-1] + steps_ns // 2
    wrong = np.flatnonzero(~(np.abs(rates) < MAX_YAW_RATE_RAD_S))
    if len(wrong):
        at = int(wrong[0])
        raise OfflineError(
            f"{where}: turns by {rates[at]:.4g} rad/s at {stamps_ns[at] * 1e-9:.3f} s, limit {MAX_YAW_RATE_RAD_S:g}; "
            "was the yaw reset, or is it in another unit? leave --imu-topic out"
        )
    said = f"gyro: {topic.name}, {plural(len(rates), 'reading')} of {'the' if is_rate else 'a yaw made into a'} rate"
    return _entries(stamps_ns, rates), said


def _radians(where: str, topic: WpiTopic, values: FloatArray) -> FloatArray:
    """Return the yaw or yaw rate (N,) in radians."""
    name = struct_name(topic)
    if name == "Rotation2d":
        return values[:, 0]
    if name == "Rotation3d":  # w, x, y, z
        if not (np.abs(np.linalg.norm(values, axis=1) - 1.0) < 0.5).all():
            raise OfflineError(f"{where}: holds a quaternion whose length is not 1; choose another topic")
        yaw: FloatArray = Rotation.from_quat(values[:, [1, 2, 3, 0]]).as_euler("ZYX")[:, 0]
        return yaw
    if topic.last == _LIMELIGHT or _DEGREES.search(topic.last):
        return np.radians(values[:, 0])
    if _RADIANS.search(topic.last):
        return values[:, 0]
    raise OfflineError(f"{where}: its name says neither degrees nor radians; choose a Rotation2d with --imu-topic")


def _entries(stamps_ns: IntArray, rates: FloatArray) -> list[Entry]:
    return [
        (stamp_ns, "/gyro", Gyro(stamp_ns=stamp_ns, yaw_rate_rad_s=rate))
        for stamp_ns, rate in zip(stamps_ns.tolist(), rates.tolist(), strict=True)
    ]
