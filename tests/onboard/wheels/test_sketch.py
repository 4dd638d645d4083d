"""The sketch in docs/robot sends what the protocol asks for, with each gyro: compiled here, with fake libraries."""

import math
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest

from groundsbot.onboard.wheels.protocol import EncoderParser, GyroLine, Unmeasured, WheelLine
from tests.support.paths import ROOT

COMPILER = shutil.which("c++")
SKETCH = ROOT / "docs" / "robot" / "groundsbot_wheels" / "groundsbot_wheels.ino"
FAKES = ROOT / "tests" / "support" / "arduino"
SECONDS = 8
START_US = 4_294_000_000

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")


def run(folder: Path, gyro: str) -> bytes:
    """What the sketch sends with one gyro."""
    program = folder / "sketch"
    options = [
        "-std=c++17",
        "-Wall",
        "-Wno-unused-function",
        "-Werror",
        f"-DGYRO=GYRO_{gyro}",
        f'-DSKETCH="{SKETCH}"',
        f"-I{FAKES}",
    ]
    command = [str(COMPILER), *options, str(FAKES / "main.cpp"), "-o", str(program)]
    subprocess.run(command, check=True)
    return subprocess.run([str(program), str(SECONDS)], check=True, stdout=subprocess.PIPE).stdout


def lines_of(data: bytes) -> tuple[list[WheelLine], list[GyroLine]]:
    """The lines, all of them intact."""
    parser = EncoderParser()
    lines = parser.feed(data)
    assert parser.rejected == 0
    assert parser.accepted == data.count(b"\n")
    wheels = [line for line in lines if isinstance(line, WheelLine)]
    return wheels, [line for line in lines if isinstance(line, GyroLine)]


def check_wheels(wheels: list[WheelLine]) -> None:
    assert len(wheels) == SECONDS * 100
    assert [line.sequence for line in wheels] == list(range(len(wheels)))
    assert {line.boot_id for line in wheels} == {42}
    assert {(after.t_us - before.t_us) % 2**32 for before, after in pairwise(wheels)} == {10_000}
    assert (wheels[-1].ticks_left, wheels[-1].ticks_right) == pytest.approx((500 * SECONDS, -500 * SECONDS), abs=10)


def test_the_sketch_without_a_gyro(tmp_path: Path) -> None:
    wheels, turns = lines_of(run(tmp_path, "NONE"))
    check_wheels(wheels)
    assert turns == []


@pytest.mark.parametrize(("gyro", "resolution_rad_s"), [("ICM20948", 2.7e-4), ("MPU6050", 2.7e-4), ("BNO085", 1e-3)])
def test_the_sketch_with_a_gyro(tmp_path: Path, gyro: str, resolution_rad_s: float) -> None:
    data = run(tmp_path, gyro)
    wheels, turns = lines_of(data)
    check_wheels(wheels)
    assert len(data) / SECONDS < 11_520  # all that 115200 baud take
    n_sent, unmeasured = 0, dict[Unmeasured, list[float]]()
    for line in turns:
        assert line.sequence == n_sent
        assert line.boot_id == 42
        for index, rate in enumerate(line.yaw_rates_urad_s):
            at_s = ((line.t_us - START_US) % 2**32 + index * line.period_us) * 1e-6
            if isinstance(rate, Unmeasured):
                unmeasured.setdefault(rate, []).append(at_s)
            else:
                late_rad_s = 2.0 * 0.0025  # half a period, where the gyro missed some
                assert rate * 1e-6 == pytest.approx(2.0 * math.sin(at_s), abs=resolution_rad_s + late_rad_s)
        n_sent += len(line.yaw_rates_urad_s)
    assert SECONDS * 190 < n_sent <= SECONDS * 200
    beyond, silent = unmeasured[Unmeasured.SATURATED], unmeasured[Unmeasured.UNREADABLE]
    assert (beyond[0], beyond[-1]) == pytest.approx((3.0, 3.1), abs=0.01)
    assert (silent[0], silent[-1]) == pytest.approx((5.0, 5.2), abs=0.03)
