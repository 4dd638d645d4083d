"""Local maps of drives, with outliers among their tags split off."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.local_map import InitialValues, LocalMap, solve_local_map, with_goodness_of_fit
from groundsbot.offline.measurements import Segment
from groundsbot.offline.noise import NoiseOfMaps
from groundsbot.offline.outliers.false_observations import without_false_detections
from groundsbot.offline.outliers.slips import slip_warning, without_slips
from groundsbot.offline.outliers.split_alone import SplitCache
from groundsbot.offline.outliers.split_drives import SplitMaps, split_at_breaks
from groundsbot.offline.sam import budgets_of


class ExplainedMaps(NamedTuple):
    """Local maps after the search for outliers and breaks of odometry.

    Attributes:
        maps: maps of segments, or of parts of segments.
        noisy: names of segments with far more noise than given, which were not searched yet.
        warnings: warnings about drives that were split at breaks of odometry.
    """

    maps: list[LocalMap]
    noisy: frozenset[str]
    warnings: list[str]


def local_maps_of(
    segments: list[Segment],
    stages: Stages,
    times: int = 1,
    *,
    noise_is_open: bool = False,
    workers: Workers | None = None,
    starts: Mapping[str, InitialValues] | None = None,
) -> ExplainedMaps:
    """Solve each segment alone, split it at breaks of odometry, and split its outlier tags.

    Both explain a drive that contradicts itself although its noise is about as given. A segment with far more noise
    than given is only solved: `remove_outliers_under_own_noise` searches it once its noise is fitted.

    Args:
        segments: segments of runs; the list is emptied, so that those of a drive are held only until it is solved.
        stages: reports progress.
        times: how often the command maps the runs; their budgets are divided by it.
        noise_is_open: as for `solve_local_map`.
        workers: processes that share the runs; None: this process.
        starts: initial values by segment, as for `solve_local_map`; those without are solved as usual.
    """
    starts = starts or {}
    of_runs: dict[str, list[Segment]] = {}
    while segments:
        segment = segments.pop(0)
        of_runs.setdefault(segment.run.name, []).append(segment)
    names = list(of_runs)

    def items() -> Iterator[_Drive]:
        while of_runs:
            own = of_runs.pop(next(iter(of_runs)))
            yield _Drive(own, times, noise_is_open, [starts.get(each.name) for each in own])
            del own

    found = (workers or Workers()).map(_local_maps_of_drive, items(), names, stages, "local maps")
    return ExplainedMaps(
        [local_map for each in found for local_map in each.maps],
        frozenset().union(*(each.noisy for each in found)),
        [warning for each in found for warning in each.warnings],
    )


class _Drive(NamedTuple):
    """Segments of a drive, how often the command maps it, whether its noise is to be fitted, and initial values."""

    segments: list[Segment]
    times: int
    noise_is_open: bool
    starts: list[InitialValues | None]


def _local_maps_of_drive(drive: _Drive, stages: Stages) -> ExplainedMaps:
    budgets = budgets_of(drive.segments, drive.times)
    maps = [
        solve_local_map(segment, budget, noise_is_open=drive.noise_is_open, start=start)
        for segment, budget, start in zip(drive.segments, budgets, drive.starts, strict=True)
    ]
    cache = SplitCache()
    with stages.stage("tags that do not belong"):
        maps = [each if each.is_noisy else cache.explain_by_tags(each) for each in maps]
    with stages.stage("breaks of odometry"):
        maps, warnings = split_at_breaks(maps, budgets)
    with stages.stage("tags that do not belong"):
        maps = [each if each.is_noisy else cache.split(each) for each in maps]
    noisy = frozenset(each.segment.name for each in maps if each.is_noisy)
    return ExplainedMaps([each.without_systems() for each in maps], noisy, warnings)


def remove_outliers_under_own_noise(
    maps: list[LocalMap],
    noisy: Collection[str],
    stages: Stages,
    workers: Workers | None = None,
    noise: NoiseOfMaps | None = None,
) -> SplitMaps:
    """Remove false detections from noisy maps, free their slips, and test their fit under the fitted noise.

    A drive that does not fit is split at breaks of odometry where these explain it. A drive that still does not fit is
    marked doubtful, and no tag of its component is then named as moved: something else violates the model. In a drive
    that fits, moved tags are found when all drives are solved together.

    Args:
        maps: the list is emptied, so that no drive is held twice.
        noisy: names of the segments with far more noise than given.
        stages: reports progress.
        workers: processes that share the maps; None: this process.
        noise: the fitted noise, under which all maps are solved first; None: they are solved under it.
    """
    left = dict(enumerate(maps))
    maps.clear()
    is_searched = {i: each.segment.name in noisy and len(each.segment.tags) > 0 for i, each in left.items()}
    begun = [i for i in left if noise is not None or is_searched[i]]
    begun.sort(key=lambda i: -len(left[i].segment.stamps_ns))  # what takes longest first, so that all end together
    names = [left[i].segment.name for i in begun]
    items = (_OwnNoise(left.pop(i), noise, is_searched[i]) for i in begun)
    found = (workers or Workers()).map(_search_under_own_noise, items, names, stages, "breaks of odometry")
    parts = dict(zip(begun, found, strict=True)) | {i: SplitMaps([each], []) for i, each in left.items()}
    ordered = [parts[i] for i in sorted(parts)]
    return SplitMaps(
        [local_map for each in ordered for local_map in each.maps],
        [warning for each in ordered for warning in each.warnings],
    )


class _OwnNoise(NamedTuple):
    """A map, the noise under which it is solved again, if any, and whether outliers and slips are searched."""

    local_map: LocalMap
    noise: NoiseOfMaps | None
    is_searched: bool


def _search_under_own_noise(item: _OwnNoise, stages: Stages) -> SplitMaps:
    local_map = item.local_map
    if item.noise is not None:
        with stages.stage("fitting the noise"):
            local_map = item.noise.solve(local_map)
    if not item.is_searched:
        return SplitMaps([local_map], [])
    warnings: list[str] = []
    found, slips = without_slips(without_false_detections(local_map))
    if slips:
        warnings.append(slip_warning(found, slips))
    with stages.stage("checking that it fits"):
        found = with_goodness_of_fit(found)
    parts = [found]
    if not found.goodness.fits:
        parts, break_warnings = split_at_breaks([replace(found, is_noisy=False)])
        warnings += break_warnings
    return SplitMaps(
        [replace(part, is_noisy=True, is_doubtful=not part.goodness.fits).without_systems() for part in parts],
        warnings,
    )
