"""The yaw rate of sensor_msgs/Imu -> the gyro readings of an imported log."""

from pathlib import Path

import numpy as np

from groundsbot.calib.foundation import plural
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.content import BagContent
from groundsbot.offline.importing.bags.frames import frame_name
from groundsbot.offline.importing.bags.reader import BagTopic
from groundsbot.offline.importing.csv.forms import MAX_YAW_RATE_RAD_S
from groundsbot.offline.importing.run_writer import Entry
from groundsbot.onboard.log import Gyro


def gyro_entries(path: Path, topic: BagTopic, content: BagContent, base_frame: str) -> list[Entry]:
    """Return (stamp, topic, message) of the yaw rate about base's vertical axis, to the left, in order of time.

    The sensor's axes are turned to base's by fixed transforms; without any its z axis is taken to point up, as REP 145
    has it, and a remark says so.

    Raises:
        OfflineError: there is no yaw rate in the messages, or one that no robot has.
    """
    where = f"{path}: {topic.name}"
    first = content.imu[0][1]
    if first.angular_velocity_covariance[0] == -1.0:
        raise OfflineError(
            f"{where}: its Imu messages are marked as without angular velocity (angular_velocity_covariance[0] is -1); "
            "give another --imu-topic, or leave it out"
        )
    frame = frame_name(first.header.frame_id)
    up = np.array([0.0, 0.0, 1.0])
    if base_frame and content.frames.are_connected(frame, base_frame):
        up = content.frames.transform(base_frame, frame).rotation.as_matrix()[2]
    else:
        content.remarks.append(f"{topic.name}: no fixed transform from {frame!r} to the base; its z axis points up")
    rates = np.array([[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for _, m in content.imu]) @ up
    wrong = np.flatnonzero(~(np.abs(rates) < MAX_YAW_RATE_RAD_S))
    if len(wrong):
        raise OfflineError(
            f"{where}: the yaw rate of message {wrong[0] + 1} is {rates[wrong[0]]:.4g}, must be below "
            f"{MAX_YAW_RATE_RAD_S:g} rad/s; was it in degrees?"
        )
    content.remarks.append(f"gyro: {topic.name}, {plural(len(rates), 'reading')}")
    return [
        (stamp_ns, "/gyro", Gyro(stamp_ns=stamp_ns, yaw_rate_rad_s=rate))
        for (stamp_ns, _), rate in zip(content.imu, rates.tolist(), strict=True)
    ]
