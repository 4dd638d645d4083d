"""sensor_msgs/Imu of a bag becomes the gyro of its log, where it is named."""

from pathlib import Path

import numpy as np
import pytest

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.importer import import_bag
from groundsbot.offline.importing.bags.topics import BagOptions
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.measurements.run import load_run
from groundsbot.onboard.log.messages import Gyro
from groundsbot.onboard.log.reading.reader import read_log
from tests.support.data.drives import HALL, PINHOLE, S, make_drive, write_drive
from tests.support.data.importing.bags import BagOfLog, good
from tests.support.data.importing.ros_messages import header, xyz

DRIVE = make_drive([1.0, 1.5, 0.3], [(0.4, 0.4, 2.0), (0.5, 0.3, 2.0)], step_ns=S // 50)
OPTIONS = ImportOptions(run_id="one", robot_id="carl", track_width_m=0.5)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("corners"), DRIVE, HALL[:3], camera=PINHOLE)


def imported(folder: Path, bag: BagOfLog, imu_topic: str | None = "/imu") -> tuple[str, ...]:
    path = bag.write(folder / "drive")
    options = BagOptions(tag_size_m=0.15, imu_topic=imu_topic)
    return import_bag(path, folder / "logs", OPTIONS, options).remarks


@pytest.mark.parametrize("upside_down", [False, True])
def test_the_yaw_rate_is_that_about_bases_vertical_axis(tmp_path: Path, log: Path, upside_down: bool) -> None:
    bag = good(log).imu(upside_down=upside_down)
    remarks = imported(tmp_path, bag)
    assert f"gyro: /imu, {len(bag.track.stamps_ns)} readings" in remarks
    gyro = [each.message for each in read_log(tmp_path / "logs" / "one") if isinstance(each.message, Gyro)]
    rates = bag.track.twist_at(bag.track.stamps_ns, bag.run.robot.wheels.track_m)[:, 2] + 0.01
    np.testing.assert_allclose([each.yaw_rate_rad_s for each in gyro], rates, atol=1e-9)
    assert [each.stamp_ns for each in gyro] == bag.track.stamps_ns.tolist()


def test_an_imu_that_is_not_named_is_not_used_and_reported(tmp_path: Path, log: Path) -> None:
    remarks = imported(tmp_path, good(log).imu(), imu_topic=None)
    assert "/imu not used; --imu-topic takes its yaw rate, unless the odometry contains it" in remarks
    assert load_run(tmp_path / "logs" / "one").gyro is None


def test_without_a_transform_its_z_axis_points_up_and_that_is_reported(tmp_path: Path, log: Path) -> None:
    bag = good(log)
    for stamp in bag.track.stamps_ns.tolist():
        fields = {"header": header(stamp, "nowhere"), "angular_velocity": xyz([0.0, 0.0, 0.2])}
        bag.add("/imu", "sensor_msgs/msg/Imu", stamp, fields)
    assert "/imu: no fixed transform from 'nowhere' to the base; its z axis points up" in imported(tmp_path, bag)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"angular_velocity": xyz([0.0, 0.0, 90.0])}, "the yaw rate of message 1 is 90, must be below 50 rad/s"),
        ({"angular_velocity": xyz([0.0, 0.0, np.nan])}, "the yaw rate of message 1 is nan, must be below 50 rad/s"),
        ({"angular_velocity_covariance": [-1.0] + 8 * [0.0]}, "marked as without angular velocity"),
    ],
)
def test_yaw_rates_that_no_robot_has_are_refused(
    tmp_path: Path, log: Path, fields: dict[str, object], said: str
) -> None:
    bag = good(log)
    stamp = int(bag.track.stamps_ns[0])
    bag.add("/imu", "sensor_msgs/msg/Imu", stamp, {"header": header(stamp, "base_link"), **fields})
    with pytest.raises(OfflineError, match=said):
        imported(tmp_path, bag)
    assert not (tmp_path / "logs").exists()
