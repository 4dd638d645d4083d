"""What each command takes of files of at most 1 MiB that were made to take memory and time.

    python -m tests.benchmarks.hostile [info salvage detect map]

Prints seconds of the processor and memory above the idle size; marks what takes over 10 s or 256 MiB, and ends with
exit code 1 then.
"""

import sys
import tempfile
from pathlib import Path

from tests.hostile_logs import HOSTILE, LIMIT_BYTES
from tests.taken_by_commands import measure

_SECONDS = 10.0
_EXTRA_BYTES = 256 << 20


def main() -> int:
    """Measures."""
    over = 0
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / f"{number}.mcap" for number, name in enumerate(HOSTILE)}
        for name, path in files.items():
            path.write_bytes(HOSTILE[name]())
            if path.stat().st_size > LIMIT_BYTES:
                raise ValueError(f"{name}: {path.stat().st_size} bytes")
        for command in sys.argv[1:] or ["info", "salvage", "detect", "map"]:
            for name, path in files.items():
                taken = measure(command, {name: path})[name]
                bad = taken.seconds > _SECONDS or taken.extra_bytes > _EXTRA_BYTES or taken.code not in (0, 1, 3)
                over += bad
                figures = f"{taken.seconds:6.2f} s {taken.extra_bytes / 2**20:6.1f} MiB"
                sys.stdout.write(f"{command:8} {name:28} exit {taken.code} {figures}{'  <- too much' if bad else ''}\n")
                sys.stdout.flush()
    return int(over > 0)


if __name__ == "__main__":
    sys.exit(main())
