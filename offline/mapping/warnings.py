"""All that a person must be told of a map, in one list."""

from collections import Counter
from collections.abc import Sequence

from groundsbot.calib.robot import TAG_SCALE
from groundsbot.offline.alignment import Merge
from groundsbot.offline.global_map import COMPARED, TagJoin, check_warnings, measurement_warnings
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.mapping.findings import Findings
from groundsbot.offline.mapping.merge_report import merge_warnings
from groundsbot.offline.maps import MAX_SIGMAS, CalibrationResult, ConsistencyCheck
from groundsbot.offline.measurements import Run, Segment


def map_warnings(
    runs: Sequence[Run],
    maps: Sequence[LocalMap],
    broken: Sequence[str],
    merged: Merge,
    found: Findings,
    not_joined: Sequence[TagJoin] | None,
) -> tuple[str, ...]:
    """All that a person must be told, in the order in which it came up, each sentence once."""
    segments = [each.segment for each in maps]
    warnings = (
        [w for run in runs for w in run.warnings] + [*broken] + [w for segment in segments for w in segment.warnings]
    )
    warnings += found.warnings + measurement_warnings(found.measured) + check_warnings(found.checks)
    warnings += calibration_warnings(found.calibration, found.checks)
    named = {(each.family, each.tag_id) for each in found.suspects} | found.left_out | _in_one_place(found)
    return tuple(
        dict.fromkeys(warnings + _segment_warnings(segments) + merge_warnings(maps, merged, named, not_joined))
    )


def _in_one_place(found: Findings) -> set[tuple[str, int]]:
    """Family and id of tags that all drives of a component together have in one place, whatever two of them had."""
    n_places = [Counter((tag.family, tag.tag_id) for tag in component.tags) for component in found.components]
    several = {each for counts in n_places for each, n in counts.items() if n > 1}
    return {each for counts in n_places for each in counts} - several


def calibration_warnings(calibration: Sequence[CalibrationResult], checks: Sequence[ConsistencyCheck]) -> list[str]:
    """Corrections that what was known beforehand makes all but impossible, but for those that a check tells of."""
    told = {
        (check.component, check.batch if name == TAG_SCALE else check.robot_id, name)
        for check in checks
        if check.contradicts
        for name in COMPARED[check.name]
    }
    return [
        f"{entry.name} of {entry.owner} came out at {entry.value:+.4f}, {abs(entry.value) / entry.prior_sigma:.0f} "
        "times the sigma it was given: wheels and tags contradict each other, or the file is of another robot"
        for entry in calibration
        if abs(entry.value) > MAX_SIGMAS * entry.prior_sigma and (entry.component, entry.owner, entry.name) not in told
    ]


def _segment_warnings(segments: Sequence[Segment]) -> list[str]:
    warnings = []
    for segment in segments:
        if segment.along_m[-1] < 0.05:
            warnings.append(f"{segment.name} never moves (its wheels turned less than 5 cm)")
        if not segment.tags and len(segments) == 1:
            warnings.append(f"{segment.name} saw no tag: its trajectory is what the wheels say, nothing corrects them")
        if len(segment.tags) == 1:
            warnings.append(
                f"{segment.name} saw a single tag, {segment.tags[0].tag_id}; two would fix its place among other runs"
            )
    return warnings
