"""What a command takes in memory and processor time of a file that may be hostile."""

import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple


class Taken(NamedTuple):
    """What one command took of one file."""

    code: int
    seconds: float  # of the processor, children included
    extra_bytes: int  # above the idle size
    said: str


# Measures in one process what each file takes; the peak is reset in between. Children count too.
_MEASURE = """
import contextlib, importlib, io, json, re, resource, shutil, sys, tempfile
from pathlib import Path
from offline import cli
for name in sys.argv[1].split(","):
    importlib.import_module(name)

def status(name, pid="self"):
    return int(re.search(name + r":\\s+(\\d+)", Path(f"/proc/{pid}/status").read_text())[1]) * 1024

def cpu_seconds():
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))

for line in sys.stdin:
    command, path = json.loads(line)
    place = Path(tempfile.mkdtemp())
    output = {"info": [], "salvage": ["-o", place / "new.mcap"]}.get(command, ["-o", place / "new"])
    sys.argv = ["groundsbot-offline", command, path, *map(str, output)]
    Path("/proc/self/clear_refs").write_text("5")
    idle = status("VmRSS")
    out, start = io.StringIO(), cpu_seconds()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            cli.main()
        except SystemExit as ended:
            code = ended.code
        except BaseException as error:
            code = 99
            print("TRACEBACK", type(error).__name__, error)
    taken = cpu_seconds() - start, status("VmHWM") - idle
    shutil.rmtree(place)
    print(json.dumps([code or 0, *taken, out.getvalue()[-300:]]), flush=True)
"""


_MODULES = {
    "info": "offline.info",
    "salvage": "offline.salvage",
    "detect": "offline.detect,onboard.picture",
    "map": "offline.map_command",
}


def measure(command: str, files: dict[str, Path]) -> dict[str, Taken]:
    """What `groundsbot-offline COMMAND` takes of each file."""
    asked = "".join(json.dumps([command, str(path)]) + "\n" for path in files.values())
    ended = subprocess.run(
        [sys.executable, "-c", _MEASURE, _MODULES[command]],
        input=asked,
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[1],
    )
    lines = ended.stdout.splitlines()
    assert len(lines) == len(files), ended.stderr
    return {name: Taken(*json.loads(line)) for name, line in zip(files, lines, strict=True)}
