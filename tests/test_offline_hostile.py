"""Files of at most 1 MiB that were made to take memory and time. Row 9 of the table of faults."""

from pathlib import Path

import pytest

from tests.hostile_logs import HOSTILE, LIMIT_BYTES
from tests.taken_by_commands import measure

EXTRA_BYTES = 256 << 20
# The others take seconds each: tests.benchmarks.hostile measures all.
QUICK = ("claimed lengths", "one bomb of 60 MiB", "chunks in chunks", "absurd index", "YAML aliases", "YAML of 1 MiB")
PICTURES = ("JPEG of 65535 x 65535", "PNG of 12000 x 12000")


@pytest.mark.parametrize(
    ("command", "names"),
    [
        ("info", QUICK),
        ("salvage", QUICK),
        ("detect", (*QUICK, *PICTURES)),
        (
            "map",
            (
                "claimed lengths",
                "extreme numbers",
                "a reset each reading",
                "tags in one picture",
                "a hundred tags a look",
            ),
        ),
        *(pytest.param(command, tuple(HOSTILE), marks=pytest.mark.long) for command in ("info", "salvage", "detect")),
    ],
)
def test_row_09_no_small_file_takes_much_memory(tmp_path: Path, command: str, names: tuple[str, ...]) -> None:
    files = {name: tmp_path / f"{number}.mcap" for number, name in enumerate(names)}
    for name, path in files.items():
        path.write_bytes(HOSTILE[name]())
        assert path.stat().st_size <= LIMIT_BYTES
    for name, taken in measure(command, files).items():
        assert taken.extra_bytes < EXTRA_BYTES, name
        assert taken.code in (0, 1, 3), (name, taken.said)  # 99: a traceback
