"""All warnings of a map, in one list."""

from collections import Counter
from collections.abc import Sequence

from groundsbot.calib.robot import TAG_SCALE
from groundsbot.offline.alignment import Merge
from groundsbot.offline.global_map import COMPARED_PARAMETERS, TagJoin, comparison_warnings, measurement_warnings
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
    """Return all warnings in the order of their origin, each sentence once."""
    segments = [each.segment for each in maps]
    warnings = (
        [w for run in runs for w in run.warnings] + [*broken] + [w for segment in segments for w in segment.warnings]
    )
    warnings += found.warnings + measurement_warnings(found.measurements) + comparison_warnings(found.checks)
    warnings += calibration_warnings(found.calibration, found.checks)
    named = {(each.family, each.tag_id) for each in found.outliers} | found.excluded_tags | _in_one_place(found)
    return tuple(dict.fromkeys(warnings + segment_warnings(segments) + merge_warnings(maps, merged, named, not_joined)))


def _in_one_place(found: Findings) -> set[tuple[str, int]]:
    """Return family and id of tags that are in one place in every component, whatever two of its drives had."""
    n_places = [Counter((tag.family, tag.tag_id) for tag in component.tags) for component in found.components]
    several = {each for counts in n_places for each, n in counts.items() if n > 1}
    return {each for counts in n_places for each in counts} - several


def calibration_warnings(calibration: Sequence[CalibrationResult], checks: Sequence[ConsistencyCheck]) -> list[str]:
    """Return warnings about corrections that the priors make nearly impossible, unless a check reports them."""
    told = {
        (check.component, check.batch if name == TAG_SCALE else check.robot_id, name)
        for check in checks
        if check.contradicts
        for name in COMPARED_PARAMETERS[check.name]
    }
    return [
        f"{entry.name} of {entry.owner} is {entry.value:+.4f}, {abs(entry.value) / entry.prior_sigma:.0f} times its "
        "given sigma: wheels and tags contradict each other, or the file is of another robot"
        for entry in calibration
        if abs(entry.value) > MAX_SIGMAS * entry.prior_sigma and (entry.component, entry.owner, entry.name) not in told
    ]


def segment_warnings(segments: Sequence[Segment]) -> list[str]:
    """Return warnings about segments that never move, or that saw hardly any tag."""
    warnings = []
    for segment in segments:
        if segment.along_m[-1] < 0.05:
            warnings.append(f"{segment.name} never moves (its wheels turned less than 5 cm)")
        if not segment.tags and len(segments) == 1:
            warnings.append(f"{segment.name} saw no tag: its trajectory is dead reckoning by the wheels, uncorrected")
        if len(segment.tags) == 1:
            warnings.append(
                f"{segment.name} saw a single tag, {segment.tags[0].tag_id}; two are needed to align it with other runs"
            )
    return warnings
