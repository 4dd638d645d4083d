"""What a command takes in memory and processor time of a file that may be hostile."""

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

from tests.support.paths import ROOT


class Taken(NamedTuple):
    """What one command took of one file."""

    code: int
    seconds: float  # of the processor, children included
    extra_bytes: int  # above the idle size
    said: str


class Form(NamedTuple):
    """How a command is called: FILE is the hostile one, OUT a new name, any other word in capitals a file beside it."""

    modules: str  # those that it is made of; what they take counts as idle
    words: str


_MAP: Final = "groundsbot.offline.commands.map_drives"
LOG_FORMS: Final = {
    "info": Form("groundsbot.offline.logs.info", "info FILE"),
    "salvage": Form("groundsbot.offline.logs.salvaging", "salvage FILE -o OUT.mcap"),
    "detect": Form("groundsbot.offline.logs.redetection,groundsbot.onboard.log.picture", "detect FILE -o OUT"),
    "map": Form(_MAP, "map FILE -o OUT"),
    "corners": Form(_MAP, "map --model corners FILE -o OUT"),
    "extend": Form(_MAP, "map --extend MAP/map.json FILE -o OUT"),
    "calibrate": Form("groundsbot.offline.commands.calibrate_robots", "calibrate FILE -o OUT.yaml"),
    "localize": Form("groundsbot.offline.commands.localize_drive", "localize FILE --map MAP -o OUT"),
}
"""All commands that take logs."""

LOGS_FORMS: Final = {name: LOG_FORMS[name] for name in ("info", "map", "corners", "extend", "calibrate", "localize")}
"""Those that take several."""

RUN_FORMS: Final = LOG_FORMS | {"salvage": Form("groundsbot.offline.logs.salvaging", "salvage FILE -o OUT")}
"""All of them on the folder of a run."""

MAP_FORMS: Final = {
    "compare": Form(
        "groundsbot.offline.evaluation.against_truth,groundsbot.offline.maps.files,groundsbot.offline.evaluation.survey",
        "compare FILE --truth TRUTH",
    ),
    "survey": Form(
        "groundsbot.offline.evaluation.against_truth,groundsbot.offline.maps.files,groundsbot.offline.evaluation.survey",
        "compare FILE --survey SURVEY",
    ),
    "g2o": Form("groundsbot.offline.maps.files,groundsbot.offline.export.export", "export FILE --format g2o -o OUT"),
    "tum": Form("groundsbot.offline.maps.files,groundsbot.offline.export.export", "export FILE --format tum -o OUT"),
    "extend": Form(_MAP, "map --extend FILE/map.json LOG -o OUT"),
    "localize": Form("groundsbot.offline.commands.localize_drive", "localize LOG --map FILE -o OUT"),
}
"""All that take a map's folder."""

OTHER_FORMS: Final = {
    "import": Form(
        "groundsbot.offline.importing.csv.importer,groundsbot.offline.importing.bags.importer",
        "import FILE -o OUT --track-width-m 0.5",
    ),
    "truth": Form(
        "groundsbot.offline.evaluation.against_truth,groundsbot.offline.maps.files,groundsbot.offline.evaluation.survey",
        "compare MAP --truth FILE",
    ),
    "survey": Form(
        "groundsbot.offline.evaluation.against_truth,groundsbot.offline.maps.files,groundsbot.offline.evaluation.survey",
        "compare MAP --survey FILE",
    ),
    "robot": Form(_MAP, "map LOG --robot FILE -o OUT"),
    "noise": Form(_MAP, "map LOG --noise FILE -o OUT"),
}
"""Commands that read files of other programs."""


# Measures in one process what each file takes; the peak is reset in between. Children count too. Not in forks of it:
# they would begin without the pages of libraries, which they take later.
_MEASURE = """
import contextlib, importlib, io, json, re, resource, shutil, sys, tempfile
from pathlib import Path
from groundsbot.offline import cli
for name in sys.argv[1].split(","):
    importlib.import_module(name)
resource.setrlimit(resource.RLIMIT_DATA, (3 << 30, 3 << 30))  # who measures shall not be taken down by it

def status(name):
    return int(re.search(name + r":\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024

def cpu_seconds():
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))

for line in sys.stdin:
    place = Path(tempfile.mkdtemp())
    sys.argv = ["groundsbot-offline", *(word.replace("OUT", str(place / "new")) for word in json.loads(line))]
    Path("/proc/self/clear_refs").write_text("5")
    idle, out, start, code = status("VmRSS"), io.StringIO(), cpu_seconds(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            cli.main()
        except SystemExit as ended:
            code = ended.code or 0
        except BaseException as error:
            code = 99
            print("TRACEBACK", type(error).__name__, error)
    taken = cpu_seconds() - start, status("VmHWM") - idle
    shutil.rmtree(place)
    print(json.dumps([code, *taken, out.getvalue()[-300:]]), flush=True)
"""


def measure(form: Form, files: Mapping[str, Path], beside: Mapping[str, Path] | None = None) -> dict[str, Taken]:
    """What a command takes of each file, one after the other; `beside`: the other files that its words name."""
    asked = "".join(json.dumps(_words(form, {"FILE": path, **(beside or {})})) + "\n" for path in files.values())
    ended = subprocess.run(
        [sys.executable, "-c", _MEASURE, form.modules],
        input=asked,
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    lines = ended.stdout.splitlines()
    assert len(lines) == len(files), ended.stderr
    return {name: Taken(*json.loads(line)) for name, line in zip(files, lines, strict=True)}


def _words(form: Form, files: Mapping[str, Path]) -> list[str]:
    """The command line, each file's name filled in where a word is or begins with its place."""
    words = []
    for word in form.words.split():
        place, slash, rest = word.partition("/")
        words.append(f"{files[place]}{slash}{rest}" if place in files else word)
    return words
