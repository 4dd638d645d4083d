"""Local maps of drives, with the tags that do not belong apart."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from groundsbot.offline.foundation import Stages
from groundsbot.offline.local_map import LocalMap, solve_local_map, with_goodness_of_fit
from groundsbot.offline.measurements import Segment
from groundsbot.offline.outliers.false_readings import without_false_detections
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
    segments: Sequence[Segment], stages: Stages, times: int = 1, *, noise_is_open: bool = False
) -> ExplainedMaps:
    """Each segment solved alone, parted where its wheels lost the way, with tags that do not belong apart.

    That is what explains a drive that contradicts itself though its wheels and readings are about as good as told. One
    whose noise is far larger than that is left as it is: its noise comes first (`remove_outliers_under_own_noise`).

    Args:
        segments: segments of runs.
        stages: told what is being done.
        times: how often the command maps the runs; what they are worth is shared out.
        noise_is_open: as for `solve_local_map`.
    """
    maps: list[LocalMap] = []
    with stages.stage("local maps", len(segments)) as done:
        efforts = budgets_of(segments, times)
        for segment, effort in zip(segments, efforts, strict=True):
            maps.append(solve_local_map(segment, effort, noise_is_open=noise_is_open))
            done()
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


def remove_outliers_under_own_noise(maps: Sequence[LocalMap], noisy: Collection[str], stages: Stages) -> JudgedMaps:
    """Noisy maps without false detections and slips, judged again under the noise that was fitted.

    A drive that does not fit is parted where its wheels lost the way, if that explains it. Where a drive does not fit
    even so, no tag of its component is taken for moved: something else is wrong. Where it
    fits, tags that moved stand out when all drives are solved together.

    Args:
        maps: solved under the fitted noise.
        noisy: names of the segments in question.
        stages: told what is being done.
    """
    found: list[LocalMap] = []
    warnings: list[str] = []
    for each in maps:
        if each.segment.name not in noisy or not each.segment.tags:
            found.append(each)
            continue
        with stages.stage("breaks of odometry"):
            again, slips = without_slips(without_false_detections(each))
        if slips:
            warnings.append(sentence(again, slips))
        with stages.stage("checking that it fits"):
            again = with_goodness_of_fit(again)
        parts = [again]
        if not again.goodness.fits:
            with stages.stage("breaks of odometry"):
                parts, broken = split_at_breaks([replace(again, is_noisy=False)])
            warnings += broken
        found += [
            replace(part, is_noisy=True, is_doubtful=not part.goodness.fits).without_factorisation() for part in parts
        ]
    return JudgedMaps(found, warnings)
