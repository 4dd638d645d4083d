"""What fitting the noise and looking for what does not belong take beside the solve of all runs together.

    python -m tests.benchmarks.speed.stages_bench [--repeats 3] [--logs FOLDER]

On the world nsh and on a fleet of ten robots with 1,000 keyframes each, simulated once without pictures and kept in
build; or on the logs of a folder. By processor time, in one process that has compiled everything, the least of some
repeats of each stage. Writes build/benchmarks/stages.jsonl. Exit 1 where the stages take more than two solves.
"""

import argparse
import sys
from pathlib import Path
from typing import Any, Final

from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.run import Run
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.command_line import say, write_report
from tests.benchmarks.speed.fleet import simulated_fleet
from tests.support.paths import ROOT

REPORT: Final = ROOT / "build" / "benchmarks" / "stages.jsonl"
NSH: Final = ROOT / "build" / "stages" / "nsh-seed0"
SOLVE: Final = "solving all runs together"
STAGES: Final = ("tags that do not belong", "breaks of odometry", "fitting the noise", "checking that it fits")
MOST_SOLVES: Final = 2.0


def main() -> int:
    """Prints a table for each set of logs and writes the report; 1 if the bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--logs", type=Path, help="of these alone")
    given = parser.parse_args()
    lines = [measure(logs, given.repeats) for logs in ([given.logs] if given.logs else [_nsh(), _fleet()])]
    write_report(REPORT, lines)
    for line in lines:
        for text in table(line):
            say(text)
    return 0 if all(line["solves"] <= MOST_SOLVES for line in lines) else 1


def measure(logs: Path, repeats: int) -> dict[str, Any]:
    """Processor seconds of each stage, and how many solves the stages come to."""
    runs = read_runs(find_logs([logs]))
    costs = [_costs(runs) for _ in range(1 + repeats)][1:]  # the first compiles
    least = {name: min(each[name] for each in costs) for name in costs[0]}
    solves = {name: least[name] / least[SOLVE] for name in STAGES}
    return {"logs": logs.name, "cpu_seconds": least, "solves_by_stage": solves, "solves": sum(solves.values())}


def table(line: dict[str, Any]) -> list[str]:
    """For a person."""
    by_stage = [
        f"{name:<28}{1e3 * line['cpu_seconds'][name]:8.1f} ms{solves:7.2f} solves"
        for name, solves in line["solves_by_stage"].items()
    ]
    return [
        f"{line['logs']}: {SOLVE} takes {1e3 * line['cpu_seconds'][SOLVE]:.1f} ms",
        *by_stage,
        f"{'together':<39}{line['solves']:7.2f} solves (at most {MOST_SOLVES:g})",
    ]


def _costs(runs: list[Run]) -> dict[str, float]:
    stages = Stages()
    build_map(runs, stages=stages)
    return {each.name: each.cpu_seconds for each in stages.costs}


def _nsh() -> Path:
    if not (NSH / TRUTH_FILE).is_file():
        simulate("nsh", 0, NSH, render=False)
    return NSH


def _fleet() -> Path:
    return simulated_fleet(10, 1000, 100, 1)


if __name__ == "__main__":
    sys.exit(main())
