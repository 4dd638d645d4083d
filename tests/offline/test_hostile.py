"""Files of at most 1 MiB that were made to take memory and time. Row 9 of the table of faults."""

from functools import cache
from pathlib import Path

import pytest

from tests.support.hostile.files import FILES
from tests.support.hostile.log_bytes import LIMIT_BYTES
from tests.support.hostile.logs import HOSTILE, honest
from tests.support.hostile.resources import LOG_FORMS, MAP_FORMS, OTHER_FORMS, Form, Taken, measure

EXTRA_BYTES = 256 << 20
# The others take seconds each: tests.benchmarks.faults.hostile measures all.
QUICK = (
    "claimed lengths",
    "one bomb of 60 MiB",
    "one bomb of 1 GiB",
    "chunks in chunks",
    "absurd index",
    "YAML aliases",
    "YAML of 1 MiB",
)
PICTURES = ("pictures of squares", "JPEG of 65535 x 65535", "PNG of 12000 x 12000")


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
                "a reset each observation",
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
        path.write_bytes(hostile_log(name))
        assert path.stat().st_size <= LIMIT_BYTES
    check(measure(LOG_FORMS[command], files))


@cache
def hostile_log(name: str) -> bytes:
    """A log that takes as much time to make as some take to refuse it."""
    return HOSTILE[name]()


def check(found: dict[str, Taken]) -> None:
    for name, taken in found.items():
        assert taken.extra_bytes < EXTRA_BYTES, name
        assert taken.code in (0, 1, 3), (name, taken.said)  # 99: a traceback


# Whose making alone takes seconds and hundreds of MiB.
LARGE = ("arrays that unfold", "a bz2 bomb.bag", "many bz2 bombs.bag", "a zstd bomb.mcap", "messages all alike.mcap")


@pytest.mark.parametrize(
    ("kind", "form"),
    [("map", MAP_FORMS["tum"]), *((kind, OTHER_FORMS[kind]) for kind in ("import", "robot", "noise"))],
    ids=["map", "import", "robot", "noise"],
)
def test_row_09_no_small_file_of_another_kind_does(tmp_path: Path, kind: str, form: Form) -> None:
    log = tmp_path / "log.mcap"
    log.write_bytes(honest())
    check(measure(form, make_file(tmp_path, kind), {"LOG": log}))


@pytest.mark.parametrize("kind", ["truth", "survey"])
def test_row_09_no_small_truth_or_survey_does(tmp_path: Path, kind: str) -> None:
    (folder,) = make_file(tmp_path, "map", "honest").values()
    check(measure(OTHER_FORMS[kind], make_file(tmp_path, kind), {"MAP": folder}))


def make_file(folder: Path, kind: str, only: str = "") -> dict[str, Path]:
    (folder / kind).mkdir()
    return {
        name: make(folder / kind / name) for name, make in FILES[kind].items() if only in name and name not in LARGE
    }
