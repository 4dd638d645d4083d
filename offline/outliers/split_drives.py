"""Split of drives at breaks of odometry into segments that only tags connect, and the warnings about it."""

from collections.abc import Sequence
from dataclasses import replace
from math import degrees, hypot
from typing import Final, NamedTuple

import numpy as np

from groundsbot.offline.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements import Segment
from groundsbot.offline.outliers.odometry_breaks import Break, budget_of_log, find_break, fits_as_one
from groundsbot.offline.sam import Budget

_MOST_BREAKS: Final = 10  # in one drive; more than that have another cause, such as the robot.yaml of another robot
_SHARE_OF_A_PART: Final = 0.5


class SplitMaps(NamedTuple):
    """Local maps of drives, split at breaks of odometry, and warnings about what was found."""

    maps: list[LocalMap]
    warnings: list[str]


class _SplitDrive(NamedTuple):
    """A drive split at its breaks.

    Attributes:
        parts: local maps of its segments.
        breaks: each with the keyframe that its own keyframes are counted from.
        is_searched: whether the budget sufficed to search the whole drive.
    """

    parts: list[LocalMap]
    breaks: list[tuple[int, Break]]
    is_searched: bool


def split_at_breaks(maps: Sequence[LocalMap], budgets: Sequence[Budget] | None = None) -> SplitMaps:
    """Split each drive at breaks of odometry, and solve the segments separately.

    Args:
        maps: maps of the drives.
        budgets: remaining budget of each drive; None: that of its whole log.
    """
    parts, warnings = [], []
    for whole, budget in zip(maps, budgets or [budget_of_log(each) for each in maps], strict=True):
        split = _split(whole, _MOST_BREAKS, budget)
        parts += split.parts
        warnings += [_break_warning(whole.segment, *each) for each in split.breaks]
        if not split.is_searched:
            warnings.append(_incomplete_warning(whole.segment))
    return SplitMaps(_rename_segments(parts) if warnings else parts, warnings)


def _split(whole: LocalMap, most: int, budget: Budget) -> _SplitDrive:
    found = find_break(whole, budget) if most else None
    if found is None:
        return _SplitDrive([whole], [], is_searched=not budget.is_spent() or fits_as_one(whole))
    segment = whole.segment
    split = _SplitDrive([], [(0, found)], is_searched=True)
    ends = (0, found.end), (found.begin, len(segment.stamps_ns))
    parts = [_without_ends(segment.part(*each), *each, segment) for each in ends]
    for (first, _), part in zip(ends, parts, strict=True):
        own = budget.take(_SHARE_OF_A_PART if part is parts[0] else 1.0)
        inner = _split(solve_local_map(part, own), most - 1, own)
        budget.give_back(own)
        breaks = [(first + offset, each) for offset, each in inner.breaks]
        split = _SplitDrive(split.parts + inner.parts, split.breaks + breaks, split.is_searched and inner.is_searched)
    return split


def _without_ends(part: Segment, first: int, end: int, whole: Segment) -> Segment:
    """Return a part without the observations next to a break: a keyframe there may have pictures from two places."""
    keyframe = part.observations.keyframe
    is_kept = (keyframe > 0) | (first == 0)
    is_kept &= (keyframe < len(part.stamps_ns) - 1) | (end == len(whole.stamps_ns))
    observations = part.observations.where(is_kept)
    observed, tag = np.unique(observations.tag, return_inverse=True)
    return replace(part, tags=tuple(part.tags[i] for i in observed), observations=replace(observations, tag=tag))


def _rename_segments(maps: Sequence[LocalMap]) -> list[LocalMap]:
    """Name segments after their run and their number in it."""
    count: dict[str, int] = {}
    numbered = []
    for each in maps:
        run = each.segment.run.name
        count[run] = count.get(run, 0) + 1
        segment = replace(each.segment, name=run if count[run] == 1 else f"{run}_stretch{count[run]}")
        numbered.append(replace(each, segment=segment, graph=replace(each.graph, segments=(segment,))))
    return numbered


def _incomplete_warning(segment: Segment) -> str:
    return (
        f"{segment.name}: its observations do not fit together, and the search for breaks of odometry was not finished "
        "within the budget for a log of this size. If the robot was lifted or pushed, map what was recorded before and "
        "after as separate runs, or leave out some pictures"
    )


def _break_warning(segment: Segment, first: int, found: Break) -> str:
    """Return the warning about a break whose keyframes are counted from `first`."""
    keyframes = np.array([found.end - 1, found.begin, *found.reach]) + first
    begin_s, end_s, earliest_s, latest_s = (segment.stamps_ns[keyframes] - segment.stamps_ns[0]) * 1e-9
    alternative = ""
    if (earliest_s, latest_s) != (begin_s, end_s):
        alternative = f" (or at another time from {earliest_s:.1f} s to {latest_s:.1f} s)"
    x_m, y_m, theta_rad = found.jump
    return (
        f"{segment.name}: between {begin_s:.1f} s and {end_s:.1f} s after its start{alternative} the robot moved by "
        f"{hypot(x_m, y_m):.2f} m and {round(degrees(theta_rad))} deg that its wheels do not explain (chi-square "
        f"{found.chi_square:.0f}, at most {found.bound:.0f} by chance). The run is split there into segments that only "
        "tags connect; if the robot was not lifted or pushed, check its wheels for slip"
    )
