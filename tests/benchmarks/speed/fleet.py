"""`groundsbot-offline map` on the logs of a simulated fleet: time and memory by stage, observation included.

    python -m tests.benchmarks.speed.fleet [--robots 10] [--keyframes 10000] [--tags 500] [--seed 1] [--workers N]

The fleet is simulated once, without pictures, and kept in build/fleet; mapping is a process of its own, with its
workers, as a person would start it. Writes build/benchmarks/fleet.jsonl. Of a fleet of the default size or larger,
exits with 1 where reading takes more than 10 microseconds a message, or building the graph more than a quarter of the
solve; both by the processor's time, so that other programs do not matter.
"""

import argparse
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import yaml

from groundsbot.calib.foundation.command_line import EXIT_DONE, EXIT_WITH_LOSSES
from groundsbot.calib.foundation.files import atomic_write
from groundsbot.offline.commands.map_summary import stage_lines
from groundsbot.offline.foundation.stages import StageCost
from tests.benchmarks.command_line import say
from tests.benchmarks.speed.fleet_world import MOST_TAGS, fleet_world
from tests.support.paths import ROOT

FLEETS: Final = ROOT / "build" / "fleet"
REPORT: Final = ROOT / "build" / "benchmarks" / "fleet.jsonl"
MOST_US_A_MESSAGE: Final = 10.0
MOST_GRAPH_SHARE: Final = 0.25
JUDGED_FROM: Final = 100_000  # keyframes; in small fleets fixed costs rule
# What `map` reads of a log.
_TOPICS: Final = ("/run", "/camera/calibration", "/wheels", "/tags/detections", "/odometry", "/tags/observations")


def main() -> int:
    """Prints the table, writes the report; 1 if a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--keyframes", type=int, default=10_000, help="of each robot, about")
    parser.add_argument("--tags", type=int, default=500, help=f"at most {MOST_TAGS}")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, help="processes that share the drives; as `map` chooses without it")
    arguments = parser.parse_args()
    logs = simulated_fleet(arguments.robots, arguments.keyframes, arguments.tags, arguments.seed)
    measure(simulated_fleet(2, 500, 40, 1))  # compiles what is not compiled yet
    line = measure(logs, arguments.workers) | {"seed": arguments.seed}
    REPORT.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(REPORT) as partial:
        partial.write_text(json.dumps(line) + "\n", encoding="utf-8")
    for text in table(line):
        say(text)
    kept = line["us_a_message"] <= MOST_US_A_MESSAGE and line["graph_share_of_solve"] <= MOST_GRAPH_SHARE
    return 0 if kept or line["keyframes"] < JUDGED_FROM else 1


def simulated_fleet(n_robots: int, n_keyframes: int, n_tags: int, seed: int) -> Path:
    """The folder of a fleet's logs, simulated unless it is there; a changed world gets a folder of its own."""
    text = world_yaml(n_robots, n_keyframes, n_tags, seed)
    name = f"{n_robots}x{n_keyframes}-{n_tags}-seed{seed}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    logs, file = FLEETS / name, FLEETS / f"{name}.yaml"
    if not (logs / "truth.json").is_file():
        FLEETS.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
        began_s = time.perf_counter()
        simulate = [sys.executable, "-m", "fixtures", "simulate", "--no-render"]
        subprocess.run(
            [*simulate, "--world", str(file), "--seed", str(seed), "--output", str(logs)],
            cwd=ROOT, check=True, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        say(f"simulated {n_robots} robots in {time.perf_counter() - began_s:.0f} s: {logs}")
    return logs


def world_yaml(n_robots: int, n_keyframes: int, n_tags: int, seed: int) -> str:
    """The content of a fleet's world file."""
    world = fleet_world(n_robots, n_keyframes, n_tags, seed).model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(world, sort_keys=False)


def measure(logs: Path, workers: int | None = None) -> dict[str, Any]:
    """One run of `map`: what it took as a whole and by stage."""
    n_messages = _n_messages(logs)
    with tempfile.TemporaryDirectory() as folder:
        began_s = time.perf_counter()
        shared = () if workers is None else ("--workers", str(workers))
        found = _offline("map", str(logs), "-o", str(Path(folder) / "map"), *shared, "--verbose", "--json")
        seconds = time.perf_counter() - began_s
        n_bytes = {path.name: path.stat().st_size for path in sorted((Path(folder) / "map").iterdir())}
    cpu_s = {stage["name"]: stage["cpu_seconds"] for stage in found["stages"]}
    peaks = [stage["peak_mib"] for stage in found["stages"] if stage["peak_mib"] is not None]
    return {
        "robots": len({run["robot"] for run in found["runs"]}),
        "keyframes": sum(run["n_keyframes"] for run in found["runs"]),
        "tags": len(found["tags"]),
        "observations": sum(tag["n_observations"] for tag in found["tags"]),
        "components": len(found["components"]),
        "messages": n_messages,
        "workers": workers,
        "seconds": seconds,
        "bytes": {name: n for name, n in n_bytes.items() if not name.endswith(".tum")},
        "peak_mib": max(peaks, default=None),
        "us_a_message": 1e6 * cpu_s["reading logs"] / n_messages,
        # 0 where no two runs are connected, so that nothing was solved but the local maps.
        "graph_share_of_solve": cpu_s["building the graph"] / cpu_s.get("solving all runs together", math.inf),
        "stages": found["stages"],
    }


def _n_messages(logs: Path) -> int:
    """Of the topics that a map is made of."""
    described = _offline("info", str(logs), "--json")
    return sum(topic["count"] for log in described for topic in log["topics"] if topic["topic"] in _TOPICS)


def _offline(*arguments: str) -> Any:  # whatever the command prints as JSON
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "groundsbot.offline.cli", *arguments]
    done = subprocess.run(command, cwd=ROOT, env=environment, check=False, stdout=subprocess.PIPE)
    if done.returncode not in (EXIT_DONE, EXIT_WITH_LOSSES):
        raise subprocess.CalledProcessError(done.returncode, command)
    return json.loads(done.stdout)


def table(line: dict[str, Any]) -> list[str]:
    """For a person."""
    what = ("robots", "keyframes", "tags", "observations", "messages")
    lines = [
        "map of " + ", ".join(f"{line[each]} {each}" for each in what),
        *stage_lines([StageCost(**stage) for stage in line["stages"]]),
    ]
    rest_s = line["seconds"] - sum(stage["seconds"] for stage in line["stages"])
    return [
        *lines,
        f"{'starting and ending':<28}{rest_s:8.2f}",
        f"{'the whole process':<28}{line['seconds']:8.2f}",
        "MiB: " + ", ".join(f"{name} {n / 2**20:.1f}" for name, n in line["bytes"].items()),
        f"observation: {line['us_a_message']:.1f} microseconds a message (at most {MOST_US_A_MESSAGE:g})",
        f"building the graph: {line['graph_share_of_solve']:.2f} of the solve (at most {MOST_GRAPH_SHARE:g})",
    ]


if __name__ == "__main__":
    sys.exit(main())
