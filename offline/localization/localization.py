"""Localizes a run in a finished map: its start, its trajectory, and the tags that moved since the map was made.

Each segment is solved alone, as for a map, and aligned with the map by shared tags. Then all segments are solved
together with the map's joint prior on tags and calibration (`solve_in_map`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from groundsbot.calib.foundation import FloatArray, StrPath, plural
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.alignment import MARGIN_NATS, reason_not_joined
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages
from groundsbot.offline.local_map import LocalMap, check_sizes_in_map
from groundsbot.offline.localization.map_prior import MapPrior, prior_from_map
from groundsbot.offline.localization.placement import Located, locate
from groundsbot.offline.localization.result import Candidate, Localization, LocatedRun, MovedTag, NotLocated
from groundsbot.offline.localization.solve_in_map import RunInMap, solve_in_map
from groundsbot.offline.maps import MapResult
from groundsbot.offline.measurements import Run, segments_of
from groundsbot.offline.noise import with_noise_of_map
from groundsbot.offline.outliers import local_maps_of, remove_outliers_under_own_noise, split_duplicates

_MAP = "the map"


def localize(
    run: Run,
    known: MapResult,
    folder: StrPath = Path(),
    *,
    noise: NoiseParameters | None = None,
    component: int | None = None,
    stages: Stages | None = None,
) -> Localization:
    """Return the trajectory of a run in a finished map.

    Args:
        run: run from `load_run`.
        known: the map, from `read_map` or `build_map`.
        folder: folder of the map, for errors.
        noise: sigmas of wheels and observations; the map's where None.
        component: index of the map's component; where None, the one that fits the run's tags.
        stages: notified of progress.

    Returns:
        The trajectory; where several poses explain the run's tags equally well, the candidates.

    Raises:
        OfflineError: no two tags have the same arrangement in the run and in the map, or the map is made of the run.
    """
    folder = Path(folder)
    stages = stages or Stages()
    _check_new(run, known, folder)
    check_sizes_in_map(run, known)
    segments = [split_duplicates(segment) for segment in segments_of(run, noise or known.noise)]
    if not any(segment.tags for segment in segments):
        raise OfflineError(
            f"{run.log}: {run.name} observed no tag, so it cannot be located in {folder}; drive past tags of the map"
        )
    maps, noisy, broken = local_maps_of(segments, stages)
    maps = with_noise_of_map(maps, noise or known.noise, known.noise_fit if noise is None else None)
    maps, slipped = remove_outliers_under_own_noise(maps, noisy, stages)
    found = localize_maps(maps, known, folder, component=component, stages=stages)
    warnings = [
        *run.warnings,
        *broken,
        *slipped,
        *(warning for each in maps for warning in each.segment.warnings),
        *found.warnings,
    ]
    losses = (f"{run.name}: located without the lost part of {run.log}: {run.lost}",) if run.lost else ()
    return replace(found, warnings=tuple(dict.fromkeys(warnings)), losses=losses)


def _check_new(run: Run, known: MapResult, folder: Path) -> None:
    """Refuse a run of the map, whose measurements would count twice, so that its sigmas would be too small."""
    for each in known.runs:
        if each.run == run.name:
            raise OfflineError(
                f"{run.log}: run {run.run_id} of robot {run.robot_id} is in the map already, with its trajectory in "
                f"{folder / each.name}.tum; localise a run that the map was not made of"
            )


def localize_maps(
    maps: Sequence[LocalMap],
    known: MapResult,
    folder: Path = Path(),
    *,
    component: int | None = None,
    stages: Stages | None = None,
) -> Localization:
    """Return the same as `localize`, from the local maps of a run's segments."""
    stages = stages or Stages()
    parts = _parts(known, folder, component)
    with stages.stage("searching for the start"):
        found = [_SegmentPlaces(each, _locate(each, parts)) for each in maps]
    _check_shared_tags(found, folder, parts)
    main = _main_component(found)
    located = [each.best for each in found if each.is_in(main)]
    not_located = tuple(each.not_located(main) for each in found if not each.is_in(main))
    if not located and not any(each.candidates for each in not_located):
        raise OfflineError(f"{maps[0].segment.run.log}: {not_located[0].reason}")
    warnings = [warning for each in maps for warning in each.goodness.warnings(each.segment.name)]
    result = Localization(folder, parts[main].frame_run, main, (), not_located, warnings=tuple(warnings))
    if not located:
        return result
    with stages.stage("solving the run in the map"):
        solved = _solve_in(located, parts[main])
    if not solved.solution.converged:
        warnings.append(f"the solve did not converge ({solved.solution.reason}); do not use this trajectory")
    new = {tag.whole for each in located for tag in each.local_map.graph.tags} - set(parts[main].instances)
    return replace(
        result,
        runs=_runs(solved),
        moved=_moved_tags(located, solved),
        new=tuple(sorted(new)),
        warnings=tuple(warnings),
        converged=solved.solution.converged,
    )


@dataclass(frozen=True)
class _SegmentPlaces:
    """A segment with its alignments to the components of a map that it shares tags with, best first."""

    local_map: LocalMap
    located: tuple[Located, ...]

    @property
    def best(self) -> Located:
        return self.located[0]

    @property
    def alternatives(self) -> tuple[Located, ...]:
        """Alignments with other components that also explain its tags."""
        best = _log_bayes_factor(self.best)
        return tuple(e for e in self.located[1:] if e.is_certain or _log_bayes_factor(e) > max(best, 0.0) - MARGIN_NATS)

    @property
    def is_certain(self) -> bool:
        """Whether the best alignment is accepted and has no alternatives."""
        return bool(self.located) and self.best.is_certain and not self.alternatives

    def is_in(self, component: int) -> bool:
        """Whether the segment is certainly in a component."""
        return self.is_certain and self.best.component == component

    def not_located(self, main: int) -> NotLocated:
        """Return why the segment is not located in the main component."""
        name = self.local_map.segment.name
        if not self.located:
            return NotLocated(name, f"{name} shares no tag with the map; drive it past two tags of the map")
        best = self.best
        if self.alternatives:
            ways = [each for each in (best, *self.alternatives) if each.alignment is not None]
            several = " and ".join(f"tags {_list_tags(each)} in component {each.component + 1}" for each in ways)
            reason = (
                f"the place of {name} is ambiguous, because it fits {several}; if both components show one place, "
                "extend the map by this run, which joins them, else choose one with --component"
            )
            return NotLocated(name, reason, tuple(c for each in ways for c in _candidates(each)))
        if best.is_certain:
            reason = f"{name} is in component {best.component + 1}, the rest of the run in component {main + 1}"
            return NotLocated(name, reason, tuple(_candidates(best)[:1]))
        reason = reason_not_joined(_MAP, name, best.shared, best.alignment)
        is_ambiguous = best.alignment is not None and len(best.alignment.alternatives) > 0
        return NotLocated(name, reason, tuple(_candidates(best)) if is_ambiguous else ())


def _parts(known: MapResult, folder: Path, component: int | None) -> dict[int, MapPrior]:
    """Return the priors of the components to search, by index."""
    n = len(known.components)
    if component is not None and not 0 <= component < n:
        raise OfflineError(f"--component {component + 1}: {folder} has {plural(n, 'component')}, 1 to {n}")
    which = range(n) if component is None else [component]
    parts = {i: prior_from_map(known.components[i], str(folder)) for i in which}
    if not any(part.tags for part in parts.values()):
        raise OfflineError(
            f"{folder}: the map has no tag of known position, so no run can be located in it; give another map"
        )
    return parts


def _locate(local_map: LocalMap, parts: dict[int, MapPrior]) -> tuple[Located, ...]:
    """Align a local map with each component that shares a tag; the best alignment is first."""
    found = [place for i, part in parts.items() if (place := locate(local_map, part, i)) is not None]
    return tuple(sorted(found, key=lambda each: (-_log_bayes_factor(each), -len(each.pairs), each.component)))


def _log_bayes_factor(located: Located) -> float:
    return float("-inf") if located.alignment is None else located.alignment.log_bayes_factor


def _check_shared_tags(found: Sequence[_SegmentPlaces], folder: Path, parts: dict[int, MapPrior]) -> None:
    if any(each.located for each in found):
        return
    run = found[0].local_map.segment.run
    seen = sorted({tag.whole for each in found for tag in each.local_map.graph.tags})
    families = sorted({tag.family for part in parts.values() for tag in part.tags})
    named = ", ".join(f"{tag.tag_id} ({tag.family})" for tag in seen[:8])
    raise OfflineError(
        f"{run.log}: none of the {plural(len(seen), 'tag')} that {run.name} observed ({named}) is in {folder} "
        f"({plural(sum(len(part.tags) for part in parts.values()), 'tag')} of {', '.join(families)}); give the map "
        "of this place"
    )


def _main_component(found: Sequence[_SegmentPlaces]) -> int:
    """Return the component of the segment with the most certain alignment."""
    placed = [each for each in found if each.located]
    best = max(placed, key=lambda each: (each.is_certain, _log_bayes_factor(each.best), -each.best.component))
    return best.best.component


def _solve_in(located: Sequence[Located], known: MapPrior) -> RunInMap:
    matches, mismatches = [each.matches() for each in located], [each.mismatches() for each in located]
    starts = np.array([each.alignment.T_a_b for each in located if each.alignment is not None])
    return solve_in_map([each.local_map for each in located], starts, matches, mismatches, known)


def _runs(solved: RunInMap) -> tuple[LocatedRun, ...]:
    state = solved.solution.state
    covariance = _in_map_axes(solved.solution.pose_covariances(np.arange(len(state.poses))), state.poses)
    runs = []
    for i, segment in enumerate(solved.graph.segments):
        first = int(solved.graph.first_pose[i])
        own = slice(first, first + len(segment.stamps_ns))
        runs.append(
            LocatedRun(
                name=segment.name,
                run=segment.run.name,
                stamps_ns=segment.stamps_ns,
                T_map_base=state.poses[own],
                covariance=covariance[own],
                tags=tuple(sorted(solved.map_tags[i])),
                distance_m=float(segment.along_m[-1]),
            )
        )
    return tuple(runs)


def _in_map_axes(covariance: FloatArray, poses: FloatArray) -> FloatArray:
    """Return covariances (K, 3, 3) of (x, y, theta) in map from those of right tangents."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    rotation = np.zeros((len(poses), 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = cos
    rotation[:, 0, 1], rotation[:, 1, 0] = -sin, sin
    rotation[:, 2, 2] = 1.0
    rotated: FloatArray = rotation @ covariance @ rotation.swapaxes(-1, -2)
    return rotated


def _moved_tags(located: Sequence[Located], solved: RunInMap) -> tuple[MovedTag, ...]:
    found = [
        MovedTag(
            tag=each.known,
            run=segment.local_map.segment.name,
            position_m=each.position_m,
            shift_m=float(np.linalg.norm(each.offset_m)),
            sigmas=each.chi2**0.5,
        )
        for segment, moved in zip(located, solved.moved, strict=True)
        for each in moved
    ]
    return tuple(sorted(found, key=lambda each: (each.tag, each.run)))


def _candidates(located: Located) -> list[Candidate]:
    if located.alignment is None:
        return []
    ways = (located.alignment, *located.alignment.alternatives)
    return [Candidate(located.component, way.T_a_b, way.inliers) for way in ways]


def _list_tags(located: Located) -> str:
    tags = () if located.alignment is None else located.alignment.inliers
    return ", ".join(f"{tag.tag_id}{tag.instance}" for tag in tags[:8])
