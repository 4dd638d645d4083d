"""Local maps of drives, with the tags that do not belong apart."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.local_map import LocalMap, solve_local_map, with_goodness_of_fit
from groundsbot.offline.measurements import Segment
from groundsbot.offline.outliers.false_observations import without_false_detections
from groundsbot.offline.outliers.odometry_breaks import split_at_breaks
from groundsbot.offline.outliers.outliers import RunsAlone
from groundsbot.offline.outliers.slips import sentence, without_slips
from groundsbot.offline.sam import budgets_of


class ExplainedMaps(NamedTuple):
    """Local maps.

    Attributes:
        maps: of segments or of parts of such.
        noisy: names of segments whose noise is far from what was told, in which nothing was looked for yet.
        warnings: sentences about drives that were parted where their wheels lost the way.
    """

    maps: list[LocalMap]
    noisy: frozenset[str]
    warnings: list[str]


def local_maps_of(
    segments: Sequence[Segment],
    stages: Stages,
    times: int = 1,
    *,
    noise_is_open: bool = False,
    workers: Workers | None = None,
) -> ExplainedMaps:
    """Each segment solved alone, parted where its wheels lost the way, with tags that do not belong apart.

    That is what explains a drive that contradicts itself though its wheels and observations are about as good as told.
    One whose noise is far larger than that is left as it is: its noise comes first (`remove_outliers_under_own_noise`).

    Args:
        segments: segments of runs.
        stages: told what is being done.
        times: how often the command maps the runs; what they are worth is shared out.
        noise_is_open: as for `solve_local_map`.
        workers: share out the runs; None: this process.
    """
    of_runs: dict[str, list[Segment]] = {}
    for segment in segments:
        of_runs.setdefault(segment.run.name, []).append(segment)
    items = [_Drive(own, times, noise_is_open) for own in of_runs.values()]
    found = (workers or Workers()).map(_local_maps_of_drive, items, list(of_runs), stages, "local maps")
    return ExplainedMaps(
        [local_map for each in found for local_map in each.maps],
        frozenset().union(*(each.noisy for each in found)),
        [warning for each in found for warning in each.warnings],
    )


class _Drive(NamedTuple):
    """The segments of a drive, how often the command maps it, and whether its noise is open."""

    segments: list[Segment]
    times: int
    noise_is_open: bool


def _local_maps_of_drive(drive: _Drive, stages: Stages) -> ExplainedMaps:
    efforts = budgets_of(drive.segments, drive.times)
    maps = [
        solve_local_map(segment, effort, noise_is_open=drive.noise_is_open)
        for segment, effort in zip(drive.segments, efforts, strict=True)
    ]
    alone = RunsAlone()
    with stages.stage("tags that do not belong"):
        maps = [each if each.is_noisy else alone.explain_by_tags(each) for each in maps]
    with stages.stage("breaks of odometry"):
        maps, broken = split_at_breaks(maps, efforts)
    with stages.stage("tags that do not belong"):
        maps = [each if each.is_noisy else alone.split(each) for each in maps]
    noisy = frozenset(each.segment.name for each in maps if each.is_noisy)
    return ExplainedMaps([each.without_factorisation() for each in maps], noisy, broken)


class JudgedMaps(NamedTuple):
    """Local maps, and sentences about drives whose wheels do not explain how they moved."""

    maps: list[LocalMap]
    warnings: list[str]


def remove_outliers_under_own_noise(
    maps: Sequence[LocalMap], noisy: Collection[str], stages: Stages, workers: Workers | None = None
) -> JudgedMaps:
    """Noisy maps without false detections and slips, judged again under the noise that was fitted.

    A drive that does not fit is parted where its wheels lost the way, if that explains it. Where a drive does not fit
    even so, no tag of its component is taken for moved: something else is wrong. Where it
    fits, tags that moved stand out when all drives are solved together.

    Args:
        maps: solved under the fitted noise.
        noisy: names of the segments in question.
        stages: told what is being done.
        workers: share out the maps; None: this process.
    """
    judged = [each for each in maps if each.segment.name in noisy and each.segment.tags]
    names = [each.segment.name for each in judged]
    again = (workers or Workers()).map(_judge_under_own_noise, judged, names, stages, "breaks of odometry")
    by_name = dict(zip(names, again, strict=True))
    parts = [by_name.get(each.segment.name, JudgedMaps([each], [])) for each in maps]
    return JudgedMaps(
        [local_map for each in parts for local_map in each.maps],
        [warning for each in again for warning in each.warnings],
    )


def _judge_under_own_noise(local_map: LocalMap, stages: Stages) -> JudgedMaps:
    warnings: list[str] = []
    found, slips = without_slips(without_false_detections(local_map))
    if slips:
        warnings.append(sentence(found, slips))
    with stages.stage("checking that it fits"):
        found = with_goodness_of_fit(found)
    parts = [found]
    if not found.goodness.fits:
        parts, broken = split_at_breaks([replace(found, is_noisy=False)])
        warnings += broken
    return JudgedMaps(
        [replace(part, is_noisy=True, is_doubtful=not part.goodness.fits).without_factorisation() for part in parts],
        warnings,
    )
