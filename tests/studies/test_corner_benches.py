"""The benches of thinning and of refining on corners, in small."""

from pathlib import Path

import numpy as np
import pytest

from groundsbot.offline.measurements import keyframes
from groundsbot.offline.measurements.run import Run, load_run
from tests.benchmarks.speed import corners_bench, thinning_bench
from tests.support.data.drives import HALL, make_drive, make_robot, write_drive


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Past tags at 0.05 m/s, where pictures are four times as dense as keyframes."""
    drive = make_drive([1.0, 1.5, 0.3], [(0.05, 0.05, 12.0), (0.05, 0.03, 6.0)])
    return load_run(write_drive(tmp_path_factory.mktemp("slow"), drive, HALL[:3], make_robot("a"), corner_sigma_px=0.2))


def test_thinning_loses_the_information_of_the_dropped_pictures(slow: Run) -> None:
    found = thinning_bench.loss([slow], corners=False)
    assert found["pictures"] > 3 * found["keyframes"]
    # With n times the looks of a tag nearly as much more is known, but for what the wheels add between keyframes.
    assert 0.2 < found["lost"] < 1.0 - found["keyframes"] / found["pictures"]
    assert np.degrees(keyframes.KEYFRAME_TURN_RAD) == pytest.approx(1.0)  # as before


def test_the_bench_of_corners_counts_solves_on_the_floor(slow: Run, tmp_path: Path) -> None:
    line = corners_bench.measure([slow, *_another(tmp_path)], repeats=1)
    assert set(line["cpu_seconds"]) == {"whole", "problem and start", "solve", "whether the floor is even"}
    assert line["solves"] == pytest.approx(line["cpu_seconds"]["whole"] / line["floor_seconds"])
    assert line["floor_seconds"] > 0.0
    assert len(corners_bench.table({"world": "made", **line})) == 6


def _another(folder: Path) -> list[Run]:
    drive = make_drive([1.2, 1.4, 0.2], [(0.2, 0.2, 4.0)])
    return [load_run(write_drive(folder, drive, HALL[:3], make_robot("b"), corner_sigma_px=0.2))]
