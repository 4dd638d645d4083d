"""Many runs: the same map in any order of the logs, and in parts, with the reason, where no tags connect the runs.

    python -m tests.benchmarks.trust.merge_study [--runs 10] [--orders 5] [--seed 1]

Ten drives through one town are merged and solved in shuffled orders; all maps, moved to one frame, must agree to
1e-6 m. Then five of them have the ids of their tags raised, as in another building: two components, and a reason. Then
the tags of every second door of a corridor are put up again one door further between two drives: ambiguous, not wrong.
Exit 1 where one of these fails.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.merging import merge
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.mapping.merge_report import merge_warnings
from groundsbot.offline.measurements.tags import TagKey
from tests.benchmarks.command_line import say
from tests.support.data.long_drives import ROAD_M, LongDrive, Town, make_long_drive, make_town

SAME_M: Final = 1e-6
LENGTH_M: Final = 500.0
TAG_SPACING_M: Final = (3.0, 12.0)
_OTHER_BUILDING: Final = 1000


def drives_of(n: int, seed: int, length_m: float = LENGTH_M) -> list[LongDrive]:
    """Through one town, with the noise that the estimate is given."""
    town = make_town(seed, TAG_SPACING_M)
    return [_drive(100 * seed + i, town, length_m) for i in range(n)]


def spread_over_orders(maps: Sequence[LocalMap], n_orders: int, seed: int) -> float:
    """The largest distance, in metres, of any tag or start between maps from shuffled orders, moved to one frame.

    Raises:
        ValueError: no tags connect the runs.
    """
    rng = np.random.default_rng(seed)
    orders = [np.arange(len(maps)), *(rng.permutation(len(maps)) for _ in range(n_orders - 1))]
    found = [_places([maps[i] for i in order]) for order in orders]
    first = found[0]
    return max(float(np.linalg.norm(each[key] - first[key], axis=-1).max()) for each in found for key in first)


def apart(maps: Sequence[LocalMap]) -> list[str]:
    """The reasons for more than one component."""
    return [text for text in merge_warnings(maps, merge(maps)) if text.startswith("component")]


def in_other_building(drive: LongDrive) -> LocalMap:
    """The same drive, past tags that no other drive saw."""
    segment = drive.segment
    tags = tuple(TagKey(tag.family, tag.tag_id + _OTHER_BUILDING) for tag in segment.tags)
    return solve_local_map(replace(segment, tags=tags))


def corridor(seed: int, length_m: float = LENGTH_M) -> list[LocalMap]:
    """Two drives along roads with a tag every 5 m; in between every second tag was put up 5 m further."""
    every_m = 5.0
    along = np.arange(2.5, 4.0 * ROAD_M, every_m)
    tags, moved = [], []
    for road in range(5):
        side = 1.5 * (-1.0) ** np.arange(len(along))
        there = np.column_stack([along, ROAD_M * road + side])
        for places, move in ((there, [2.0 * every_m, 0.0]), (there[:, ::-1], [0.0, 2.0 * every_m])):
            tags.append(places)
            moved.append(places + np.where(np.arange(len(along))[:, None] % 4 < 2, move, 0.0))
    before, after = (Town(np.concatenate(each), 0.0) for each in (tags, moved))
    return [solve_local_map(_drive(seed + i, town, length_m).segment) for i, town in enumerate((before, after))]


def _drive(seed: int, town: Town, length_m: float) -> LongDrive:
    return make_long_drive(seed, length_m, town=town, noise=NoiseParameters(), noise_factors=(1.0, 1.0))


def _places(maps: Sequence[LocalMap]) -> dict[object, FloatArray]:
    """Tags and starts in the frame of the run whose name comes first."""
    merged = merge(maps)
    if len(merged.groups) != 1:
        raise ValueError("; ".join(merge_warnings(maps, merged)))
    graph, solution = solve_global_map(maps, merged.groups[0], Stages())
    starts = {
        segment.name: solution.state.poses[first]
        for segment, first in zip(graph.segments, graph.first_pose, strict=True)
    }
    T_first_map = se2.inverse(starts[min(starts)])
    places: dict[object, FloatArray] = {
        tag: se2.apply(T_first_map, at) for tag, at in graph.tags_of(solution.state).items()
    }
    return places | {name: se2.apply(T_first_map, start[:2]) for name, start in starts.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--orders", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args(arguments)
    drives = drives_of(given.runs, given.seed)
    maps = [solve_local_map(drive.segment) for drive in drives]
    began_s = time.perf_counter()
    merged = merge(maps)
    say(f"{len(merged.pairs)} pairs of {given.runs} runs aligned in {time.perf_counter() - began_s:.1f} s")
    spread_m = spread_over_orders(maps, given.orders, given.seed)
    say(f"{given.orders} orders: the maps agree to {spread_m:.1e} m (at most {SAME_M:g})")
    half = given.runs // 2
    two = apart([*maps[:half], *(in_other_building(drive) for drive in drives[half:])])
    say("two buildings: " + "; ".join(two))
    repeated = apart(corridor(given.seed))
    say("corridor: " + "; ".join(repeated))
    good = spread_m <= SAME_M and len(two) == 1 and len(repeated) == 1 and "ambiguous, because" in repeated[0]
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
