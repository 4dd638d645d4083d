"""What keyframes lose of the information that all pictures have.

    python -m tests.benchmarks.speed.thinning_bench [--worlds room,nsh] [--seed 0]

A picture becomes a keyframe when the robot moved or turned by a little, or when it shows a tag that the last one did
not (`offline/measurements/segment.py`); others are passed over. Drives without rendering are mapped so and with every
picture a keyframe, under the true noise, on places and on corners. Information of one dimension is that of the joint
covariance of all tags' places, (det S)^(-1/n). Writes build/benchmarks/thinning.jsonl; exit 1 where more than a
twentieth is lost.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import Component
from groundsbot.offline.measurements import keyframes
from groundsbot.offline.measurements.run import Run
from tests.benchmarks.command_line import say, write_report
from tests.support.data.simulated_runs import simulated_runs
from tests.support.paths import ROOT

REPORT: Final = ROOT / "build" / "benchmarks" / "thinning.jsonl"
MOST_LOST: Final = 0.05
_MOVED_M: Final = 5e-4  # beyond what an encoder flickers
_TURNED_RAD: Final = 2e-3


@contextmanager
def every_picture_a_keyframe() -> Iterator[None]:
    """As if the robot had always moved far enough, but where it stands: there errors of pictures are the same ones."""
    before = keyframes.KEYFRAME_DISTANCE_M, keyframes.KEYFRAME_TURN_RAD
    keyframes.KEYFRAME_DISTANCE_M, keyframes.KEYFRAME_TURN_RAD = _MOVED_M, _TURNED_RAD  # type: ignore[misc]
    try:
        yield
    finally:
        keyframes.KEYFRAME_DISTANCE_M, keyframes.KEYFRAME_TURN_RAD = before  # type: ignore[misc]


def loss(runs: Sequence[Run], *, corners: bool) -> dict[str, Any]:
    """Keyframes with and without thinning, and the share of the information that is lost.

    Raises:
        ValueError: a map is in parts, so that there is nothing to compare.
    """
    thinned = _map_runs(runs, corners=corners)
    with every_picture_a_keyframe():
        whole = _map_runs(runs, corners=corners)
    (_, log_thinned), (_, log_whole) = (np.linalg.slogdet(each.tag_covariance) for each in (thinned, whole))
    share = 1.0 - np.exp((log_whole - log_thinned) / len(whole.tag_covariance))
    return {"keyframes": _keyframes(thinned), "pictures": _keyframes(whole), "lost": float(share)}


def _map_runs(runs: Sequence[Run], *, corners: bool) -> Component:
    components = build_map(runs, NoiseParameters(), corners=corners).components
    if len(components) > 1:
        raise ValueError(f"{len(components)} components")
    return components[0]


def _keyframes(component: Component) -> int:
    return sum(len(run.stamps_ns) for run in component.runs)


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where no world loses more than is promised, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default="room,nsh", help="[room,nsh]")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    given = parser.parse_args(arguments)
    lines = []
    for world in given.worlds.split(","):
        runs, _ = simulated_runs(world, given.seed)
        for corners in (False, True):
            line = {"world": world, "model": "corners" if corners else "2d", **loss(runs, corners=corners)}
            say(
                f"{world:<10}{line['model']:<8} {line['keyframes']:6d} keyframes of {line['pictures']} pictures "
                f"lose {100.0 * line['lost']:.2f} % of the information (at most {100.0 * MOST_LOST:g})"
            )
            lines.append(line)
    write_report(REPORT, lines)
    return 0 if all(line["lost"] <= MOST_LOST for line in lines) else 1


if __name__ == "__main__":
    sys.exit(main())
