"""What `check` says of a gyro: rate, bias, noise, sign; and of one that is missing, frozen or wrong."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.calib.robot.wiring import WIRINGS, Wiring
from groundsbot.onboard.monitoring.gyro_check import describe_gyro, measure_standing
from groundsbot.onboard.wheels.intake import StampedGyro, StampedReading, WheelIntake
from groundsbot.onboard.wheels.protocol import GyroLine, Unmeasured, WheelLine, format_gyro_line, format_line
from tests.support.devices.recorder_cores import ROBOT_YAML

ROBOT = parse_robot_yaml(ROBOT_YAML, "robot.yaml")
WITH_GYRO = parse_robot_yaml(ROBOT_YAML + "gyro: {}\n", "robot.yaml")
PERIOD_S = 0.005
LINE_S = 0.01


@dataclass(frozen=True)
class Meanwhile:
    """What the robot does while `check` listens, and its gyro."""

    seconds: float = 2.0
    stands_s: float = math.inf  # then it turns on the spot by 1 rad/s
    bias_rad_s: float = math.radians(0.7)
    noise_rad_per_sqrt_s: float = math.radians(0.02)
    scale: float = 1.0
    sends: bool = True
    wiring: Wiring = field(default_factory=Wiring)

    def listen(self) -> tuple[list[StampedReading], list[StampedGyro], WheelIntake]:
        """The readings, as the port gives them."""
        rng, intake, found = np.random.default_rng(5), WheelIntake(), list[StampedReading | StampedGyro]()
        for index in range(round(self.seconds / LINE_S)):
            at_s = index * LINE_S
            ticks = round(max(0.0, at_s - self.stands_s) * 0.15 / 0.05 / (2.0 * math.pi) * 1024)
            left, right = self.wiring.signs
            counts = self.wiring.order(-left * ticks, right * ticks)
            data = format_line(WheelLine(7, index, round(at_s * 1e6), *counts, 0))
            rate = self.bias_rad_s + self.scale * float(at_s > self.stands_s)
            noise = self.noise_rad_per_sqrt_s / PERIOD_S**0.5 * rng.standard_normal(2)
            rates = tuple(np.rint(1e6 * (rate + noise)).astype(int).tolist())
            if self.sends:
                data += format_gyro_line(GyroLine(7, 2 * index, round(at_s * 1e6), 5_000, rates))
            found += intake.feed(data, round(at_s * 1e9) + 9_000_000)
        found += intake.release_all()
        wheels = [each for each in found if isinstance(each, StampedReading)]
        return wheels, [each for each in found if isinstance(each, StampedGyro)], intake


STANDING = Meanwhile()
TURNED = Meanwhile(seconds=6.0, stands_s=3.0)


def said_of(meanwhile: Meanwhile, with_gyro: bool = True) -> tuple[bool, str] | None:
    wheels, samples, intake = meanwhile.listen()
    robot = WITH_GYRO if with_gyro else ROBOT
    exchanged, left, right = meanwhile.wiring
    wiring = {"encoders_exchanged": exchanged, "left_encoder_reversed": left, "right_encoder_reversed": right}
    wired = robot.model_copy(update={"wheels": robot.wheels.model_copy(update=wiring)})
    return describe_gyro(wheels, samples, intake.gyro, wired)


def test_bias_and_noise_while_standing() -> None:
    found = measure_standing(*Meanwhile(seconds=20.0).listen()[:2])
    assert found is not None
    assert found.bias_rad_s == pytest.approx(math.radians(0.7), abs=3.0 * math.radians(0.02) / 20.0**0.5)
    assert found.noise_rad_per_sqrt_s == pytest.approx(math.radians(0.02), rel=0.2)
    assert not found.is_frozen


def test_only_what_was_measured_while_standing_counts() -> None:
    found = measure_standing(*TURNED.listen()[:2])
    assert found is not None
    assert found.bias_rad_s == pytest.approx(math.radians(0.7), abs=math.radians(0.05))
    assert measure_standing(*Meanwhile(seconds=3.0, stands_s=0.3).listen()[:2]) is None


def test_a_gyro_that_is_fit() -> None:
    said = said_of(STANDING)
    assert said is not None
    passed, text = said
    assert passed
    assert text.startswith("200 samples/s, bias +0.69 deg/s, noise 0.020 deg per root s")
    assert text.endswith("sign not checked: turn the robot meanwhile, with --listen-s 10")
    assert said == said_of(STANDING, with_gyro=False)  # robot.yaml need not have one


@pytest.mark.parametrize("wiring", WIRINGS)
def test_the_sign_against_the_wheels(wiring: Wiring) -> None:
    said = said_of(replace(TURNED, wiring=wiring))
    assert said is not None
    passed, text = said
    assert passed
    assert text.endswith("turns 1.00 times as far as the wheels")


@pytest.mark.parametrize(
    ("meanwhile", "words"),
    [
        (replace(TURNED, scale=-1.0), "turns -1.00 times as far as the wheels; the other way round"),
        (replace(TURNED, scale=0.1), "check its axis and unit"),
        (replace(STANDING, bias_rad_s=0.2), "the bias is beyond 4 times gyro.bias_rad_s_sigma 0.0349066"),
        (replace(STANDING, noise_rad_per_sqrt_s=0.01), "the noise is beyond 10 times gyro.noise_rad_per_sqrt_s"),
        (replace(STANDING, noise_rad_per_sqrt_s=0.0), "the gyro is frozen"),
        (replace(STANDING, sends=False), "robot.yaml has a gyro, but the controller sends no lines of one"),
    ],
)
def test_a_gyro_that_is_not(meanwhile: Meanwhile, words: str) -> None:
    said = said_of(meanwhile)
    assert said is not None
    passed, text = said
    assert not passed
    assert words in text


def test_no_gyro_is_no_fault_where_none_is_expected() -> None:
    assert said_of(replace(STANDING, sends=False), with_gyro=False) is None


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (GyroLine(7, 400, 2_000_000, 5_000, (Unmeasured.UNREADABLE,) * 3), "0 samples saturated, 3 unreadable"),
        (GyroLine(7, 400, 2_000_000, 5_000, (Unmeasured.SATURATED, 3)), "1 sample saturated, 0 unreadable"),
        (GyroLine(7, 400, 60_000_000, 5_000, (5, 3)), "2 samples with a wrong time"),
        (GyroLine(7, 5_000_000, 2_000_000, 5_000, (5, 3)), "1 line with a wrong sequence"),
    ],
)
def test_samples_that_are_none(line: GyroLine, words: str) -> None:
    wheels, samples, intake = STANDING.listen()
    intake.feed(format_gyro_line(line), 2_000_000_000)
    said = describe_gyro(wheels, samples, intake.gyro, ROBOT)
    assert said is not None
    passed, text = said
    assert not passed
    assert words in text
