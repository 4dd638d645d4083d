"""What each command takes of files of at most 1 MiB that were made to take memory and time.

    python -m tests.benchmarks.faults.hostile [COMMAND ...] [--only WORD]

COMMAND is one of those of LOG_FORMS, MAP_FORMS and OTHER_FORMS in tests.support.hostile.resources (`localize` is both:
a hostile log in a map, and a log in a hostile map), all of them unless some are named; `--only` takes the files with
this word in their names. Prints seconds of the processor and memory above the idle size; marks what takes over 10 s or
256 MiB, and ends with exit code 1 then.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from groundsbot.offline.commands.map_drives import MapOptions, make_map
from tests.support.hostile.files import FILES, LOGS, truth_and_survey
from tests.support.hostile.log_bytes import LIMIT_BYTES
from tests.support.hostile.logs import honest
from tests.support.hostile.resources import LOG_FORMS, LOGS_FORMS, MAP_FORMS, OTHER_FORMS, RUN_FORMS, Form, measure

_SECONDS = 10.0
_EXTRA_BYTES = 256 << 20
_KINDS = (("log", LOG_FORMS), ("run", RUN_FORMS), ("logs", LOGS_FORMS), ("map", MAP_FORMS))


def main() -> int:
    """Measures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("commands", nargs="*", default=[*LOG_FORMS, *MAP_FORMS, *OTHER_FORMS])
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    over = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        beside = _beside(folder)
        for command, form, files in _cases(folder, [*dict.fromkeys(options.commands)], options.only):
            for case, path in files.items():
                taken = measure(form, {case: path}, beside)[case]
                bad = taken.seconds > _SECONDS or taken.extra_bytes > _EXTRA_BYTES or taken.code not in (0, 1, 3)
                over += bad
                figures = f"{taken.seconds:6.2f} s {taken.extra_bytes / 2**20:6.1f} MiB"
                sys.stdout.write(f"{command:9} {case:34} exit {taken.code} {figures}{'  <- too much' if bad else ''}\n")
                sys.stdout.flush()
    return int(over > 0)


def _cases(folder: Path, commands: list[str], only: str) -> Iterator[tuple[str, Form, dict[str, Path]]]:
    """Command, its form, files by names in words."""
    kinds = {"log": LOGS, **FILES}
    files: dict[str, dict[str, Path]] = {}
    for command in commands:
        for kind, forms in (*_KINDS, (command, OTHER_FORMS)):
            if command not in forms:
                continue
            if kind not in files:
                (folder / kind).mkdir()
                files[kind] = dict(_write_files(folder / kind, kinds[kind], only))
            yield command, forms[command], files[kind]


def _write_files(folder: Path, makers: Mapping[str, Callable[[Path], Path]], only: str) -> Iterator[tuple[str, Path]]:
    for name, make in makers.items():
        if only not in name:
            continue
        path = make(folder / name)
        size = sum(each.stat().st_size for each in [path, *path.rglob("*")] if each.is_file())
        if size > LIMIT_BYTES:
            raise ValueError(f"{name}: {size} bytes")
        yield name, path


def _beside(folder: Path) -> dict[str, Path]:
    """An undamaged log, its map, and the truth and survey of it."""
    log = folder / "honest.mcap"
    log.write_bytes(honest())
    make_map(MapOptions([log], folder / "mapped"))
    truth, survey = truth_and_survey(folder)
    return {"LOG": log, "MAP": folder / "mapped", "TRUTH": truth, "SURVEY": survey}


if __name__ == "__main__":
    sys.exit(main())
