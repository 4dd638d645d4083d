"""How many drives may be mapped together."""

from pathlib import Path

import pytest

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.mapping.inputs import _check_segments
from groundsbot.offline.measurements.run import ALONE, Inputs
from groundsbot.onboard.log import size_bytes


def test_drives_that_were_driven_may_be_any_number() -> None:
    _check_segments(1000, Inputs(1000, 1000 * 100_000), Path("r999"))
    _check_segments(20, Inputs(20, 20 * 1000), Path("r19"))  # a few may have broken off at once
    _check_segments(10_000, ALONE, Path("r"))  # one log's own limits are others


def test_a_thousand_tiny_ones_are_refused_with_a_way_out() -> None:
    with pytest.raises(OfflineError) as refused:
        _check_segments(1000, Inputs(1000, 1 << 20), Path("r999"))
    (line,) = str(refused.value).splitlines()
    assert line.startswith(
        "r999: the logs up to this one have 1000 segments of drives, limit 41 for 1000 logs of 1048576 bytes"
    )
    assert "--extend" in line


def test_the_size_is_that_of_all_files(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "0000.core.mcap").write_bytes(b"x" * 10)
    (run / "0001.core.mcap").write_bytes(b"x" * 5)
    single = tmp_path / "other.mcap"
    single.write_bytes(b"x" * 7)
    assert size_bytes(run) == 15
    assert Inputs.of([run, single, tmp_path / "gone"]) == Inputs(3, 22)
