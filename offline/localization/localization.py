"""A new run in a finished map, which stays as it is: where it started, its trajectory, and which tags were moved since.

Each segment alone, as for a map; its place from the tags that it shares with the map; then all segments in one solve
in which the map's tags and calibration are known as the map knows them (`solve_in_map`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from groundsbot.calib.foundation import FloatArray, plural
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
    folder: Path = Path(),
    *,
    noise: NoiseParameters | None = None,
    component: int | None = None,
    stages: Stages | None = None,
) -> Localization:
    """The trajectory of a run in a finished map.

    Args:
        run: of `load_run`.
        known: of `read_map` or `build_map`.
        folder: of the map, for errors.
        noise: sigmas of wheels and observations; the map's where None.
        component: of the map, where it has several; the one that the run's tags fit where None.
        stages: told what is being done.

    Returns:
        What was found; where several places explain the run's tags alike, the candidates.

    Raises:
        OfflineError: the run shares no two tags with the map that lie in it as they do in the run.
    """
    stages = stages or Stages()
    check_sizes_in_map(run, known)
    segments = [split_duplicates(segment) for segment in segments_of(run, noise or known.noise)]
    if not any(segment.tags for segment in segments):
        raise OfflineError(f"{run.log}: {run.name} saw no tag, so nothing tells where in {folder} it drove")
    maps, noisy, broken = local_maps_of(segments, stages)
    maps = with_noise_of_map(maps, noise or known.noise, known.noise_fit if noise is None else None)
    maps, slipped = remove_outliers_under_own_noise(maps, noisy, stages)
    found = localize_maps(maps, known, folder, component=component, stages=stages)
    told = [
        *run.warnings,
        *broken,
        *slipped,
        *(warning for each in maps for warning in each.segment.warnings),
        *found.warnings,
    ]
    losses = (f"{run.name}: located without what is lost of {run.log}: {run.lost}",) if run.lost else ()
    return replace(found, warnings=tuple(dict.fromkeys(told)), losses=losses)


def localize_maps(
    maps: Sequence[LocalMap],
    known: MapResult,
    folder: Path = Path(),
    *,
    component: int | None = None,
    stages: Stages | None = None,
) -> Localization:
    """As `localize`, from the local maps of a run's segments."""
    stages = stages or Stages()
    parts = _parts(known, folder, component)
    with stages.stage("looking for the start"):
        found = [_SegmentPlaces(each, _locate(each, parts)) for each in maps]
    _check_shared_tags(found, folder, parts)
    home = _home(found)
    here = [each.best for each in found if each.is_in(home)]
    not_located = tuple(each.why(home) for each in found if not each.is_in(home))
    if not here and not any(each.candidates for each in not_located):
        raise OfflineError(f"{maps[0].segment.run.log}: {not_located[0].reason}")
    warnings = [sentence for each in maps for sentence in each.goodness.warnings(each.segment.name)]
    located = Localization(folder, parts[home].frame_run, home, (), not_located, warnings=tuple(warnings))
    if not here:
        return located
    with stages.stage("solving the run in the map"):
        held = _solve_in(here, parts[home])
    if not held.solution.converged:
        warnings.append(f"the solve did not converge ({held.solution.reason}); do not trust this trajectory")
    new = {tag.whole for each in here for tag in each.local_map.graph.tags} - set(parts[home].instances)
    return replace(
        located,
        runs=_runs(held),
        moved=_moved_tags(here, held),
        new=tuple(sorted(new)),
        warnings=tuple(warnings),
    )


@dataclass(frozen=True)
class _SegmentPlaces:
    """One segment against the components of a map, best first; those that it shares tags with."""

    local_map: LocalMap
    located: tuple[Located, ...]

    @property
    def best(self) -> Located:
        return self.located[0]

    @property
    def alternatives(self) -> tuple[Located, ...]:
        """Places in other components that explain its tags too."""
        best = _evidence(self.best)
        return tuple(e for e in self.located[1:] if e.is_sure or _evidence(e) > max(best, 0.0) - MARGIN_NATS)

    @property
    def is_sure(self) -> bool:
        """In one place."""
        return bool(self.located) and self.best.is_sure and not self.alternatives

    def is_in(self, component: int) -> bool:
        """Surely there."""
        return self.is_sure and self.best.component == component

    def why(self, home: int) -> NotLocated:
        """Why its place is not told."""
        name = self.local_map.segment.name
        if not self.located:
            return NotLocated(name, f"{name} shares no tag with the map; drive it past two tags of the map")
        best = self.best
        if self.alternatives:
            ways = [each for each in (best, *self.alternatives) if each.alignment is not None]
            several = " and ".join(f"tags {_list_runs(each)} in component {each.component}" for each in ways)
            reason = (
                f"where {name} drove is ambiguous, because it fits {several}: if both are one place, extend the map by "
                "this run, which joins them; else choose one with --component"
            )
            return NotLocated(name, reason, tuple(c for each in ways for c in _candidates(each)))
        if best.is_sure:
            reason = f"{name} is in component {best.component}, the rest of the run in component {home}"
            return NotLocated(name, reason, tuple(_candidates(best)[:1]))
        reason = reason_not_joined(_MAP, name, best.shared, best.alignment)
        is_ambiguous = best.alignment is not None and len(best.alignment.alternatives) > 0
        return NotLocated(name, reason, tuple(_candidates(best)) if is_ambiguous else ())


def _parts(known: MapResult, folder: Path, component: int | None) -> dict[int, MapPrior]:
    """The components to look in."""
    n = len(known.components)
    if component is not None and not 0 <= component < n:
        raise OfflineError(f"--component {component}: {folder} has {plural(n, 'component')}, 0 to {n - 1}")
    which = range(n) if component is None else [component]
    parts = {i: prior_from_map(known.components[i], str(folder)) for i in which}
    if not any(part.tags for part in parts.values()):
        raise OfflineError(f"{folder}: the map has no tag whose place it knows, so no run can be placed in it")
    return parts


def _locate(local_map: LocalMap, parts: dict[int, MapPrior]) -> tuple[Located, ...]:
    """In each component that shares a tag, best first."""
    found = [place for i, part in parts.items() if (place := locate(local_map, part, i)) is not None]
    return tuple(sorted(found, key=lambda each: (-_evidence(each), -len(each.pairs), each.component)))


def _evidence(located: Located) -> float:
    return float("-inf") if located.alignment is None else located.alignment.log_bayes_factor


def _check_shared_tags(found: Sequence[_SegmentPlaces], folder: Path, parts: dict[int, MapPrior]) -> None:
    if any(each.located for each in found):
        return
    run = found[0].local_map.segment.run
    seen = sorted({tag.whole for each in found for tag in each.local_map.graph.tags})
    families = sorted({tag.family for part in parts.values() for tag in part.tags})
    named = ", ".join(f"{tag.tag_id} ({tag.family})" for tag in seen[:8])
    raise OfflineError(
        f"{run.log}: none of the {plural(len(seen), 'tag')} that {run.name} saw ({named}) is in {folder} "
        f"({plural(sum(len(part.tags) for part in parts.values()), 'tag')} of {', '.join(families)}); is it the "
        "map of this place?"
    )


def _home(found: Sequence[_SegmentPlaces]) -> int:
    """The component of the segment that is surest."""
    placed = [each for each in found if each.located]
    best = max(placed, key=lambda each: (each.is_sure, _evidence(each.best), -each.best.component))
    return best.best.component


def _solve_in(here: Sequence[Located], known: MapPrior) -> RunInMap:
    names, maybe = [each.names() for each in here], [each.others() for each in here]
    starts = np.array([_transform(each) for each in here])
    return solve_in_map([each.local_map for each in here], starts, names, maybe, known)


def _transform(located: Located) -> FloatArray:
    if located.alignment is None:
        raise ValueError("not located")
    return located.alignment.T_a_b


def _runs(held: RunInMap) -> tuple[LocatedRun, ...]:
    state = held.solution.state
    covariance = _in_map_axes(held.solution.pose_covariances(np.arange(len(state.poses))), state.poses)
    runs = []
    for i, segment in enumerate(held.graph.segments):
        first = int(held.graph.first_pose[i])
        own = slice(first, first + len(segment.stamps_ns))
        runs.append(
            LocatedRun(
                name=segment.name,
                run=segment.run.name,
                stamps_ns=segment.stamps_ns,
                T_map_base=state.poses[own],
                covariance=covariance[own],
                tags=tuple(sorted(held.held[i])),
                distance_m=float(segment.along_m[-1]),
            )
        )
    return tuple(runs)


def _in_map_axes(covariance: FloatArray, poses: FloatArray) -> FloatArray:
    """(K, 3, 3) from right perturbations to (x, y, theta) in map."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.zeros((len(poses), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = cos
    turn[:, 0, 1], turn[:, 1, 0] = -sin, sin
    turn[:, 2, 2] = 1.0
    turned: FloatArray = turn @ covariance @ turn.swapaxes(-1, -2)
    return turned


def _moved_tags(here: Sequence[Located], held: RunInMap) -> tuple[MovedTag, ...]:
    found = [
        MovedTag(
            tag=each.known,
            run=place.local_map.segment.name,
            position_m=each.position_m,
            shift_m=float(np.linalg.norm(each.off_m)),
            sigmas=each.squares**0.5,
        )
        for place, elsewhere in zip(here, held.elsewhere, strict=True)
        for each in elsewhere
    ]
    return tuple(sorted(found, key=lambda each: (each.tag, each.run)))


def _candidates(located: Located) -> list[Candidate]:
    if located.alignment is None:
        return []
    ways = (located.alignment, *located.alignment.alternatives)
    return [Candidate(located.component, way.T_a_b, way.inliers) for way in ways]


def _list_runs(located: Located) -> str:
    tags = () if located.alignment is None else located.alignment.inliers
    return ", ".join(f"{tag.tag_id}{tag.instance}" for tag in tags[:8])
