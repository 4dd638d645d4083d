"""Advice on what to record next: candidates ranked by the largest tag sigma that they would leave.

The criterion is the largest sigma of any tag along its worst direction, relative to the other tags, predicted with the
candidate's measurements added: the shape, since no drive fixes the heading of the whole (`maps.shape`). It follows
from the joint covariance of the solved map, without another solve (`information_gain`). The best candidate of each kind
is reported: a drive to repeat (`passes`), and a new tag that the same drives would have observed (`new_tags`).
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import Final, NamedTuple

import numpy as np
from numpy.linalg import LinAlgError

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.advice.information_gain import InformationGain, JointCovariance
from groundsbot.offline.advice.new_tags import (
    DrivePaths,
    TagSite,
    ViewStatistics,
    drive_paths,
    new_tag_gain,
    tag_sites,
    view_statistics,
)
from groundsbot.offline.advice.passes import (
    RepeatDrive,
    TagTrack,
    driven_distances_m,
    repeat_drive_gain,
    repeat_drives,
    tag_tracks,
)
from groundsbot.offline.advice.visibility import expected_sigmas_m
from groundsbot.offline.maps import AdviceResult, common_motion, without_common_motion
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import MAX_RELATIVE_ERROR, Graph, Solution, State

# Enough points to draw a path.
_MOST_POINTS: Final = 40


class Candidates(NamedTuple):
    """Candidates, and the statistics that they are judged by."""

    tracks: list[TagTrack]
    paths: DrivePaths
    view_statistics: ViewStatistics
    repeat_drives: list[RepeatDrive]
    tag_sites: list[TagSite]


class RatedCandidate(NamedTuple):
    """A candidate with the tags' sigmas (T,), now and predicted, and whether these are relative to the other tags."""

    kind: str
    candidate: RepeatDrive | TagSite
    sigmas_m: FloatArray
    predicted_sigmas_m: FloatArray
    of_shape: bool


def advise(graph: Graph, solution: Solution, component: int) -> list[AdviceResult]:
    """Return the best drive to repeat and the best new tag, the better first; none if covariances are unreliable.

    Args:
        graph: graph of the component.
        solution: solution of that graph.
        component: its index.
    """
    is_sound = solution.converged and not solution.unobservable.n_directions
    if not graph.tags or not is_sound or solution.relative_error() > MAX_RELATIVE_ERROR:
        return []
    return [_advice_result(graph, solution, each, component) for each in best_candidates(graph, solution)]


def best_candidates(graph: Graph, solution: Solution) -> list[RatedCandidate]:
    """Return the best drive to repeat and the best new tag, as far as there are candidates, the better one first."""
    _, drives, view, passes, places = find_candidates(graph, solution.state)
    gains: list[tuple[str, RepeatDrive | TagSite, InformationGain]] = []
    for each in passes:
        with suppress(LinAlgError):  # rounding left its poses unobservable
            gains.append(("pass", each, repeat_drive_gain(graph, solution.state, each)))
    gains += [("tag", each, new_tag_gain(drives, view, each)) for each in places]
    known = tag_joint_covariance(solution, [gain for _, _, gain in gains])
    now_m = known.sigmas_m()
    then = []
    for kind, candidate, gain in gains:
        if isinstance(candidate, TagSite):
            then_m = expected_sigmas_m(drives, view, candidate, known)
        else:
            then_m = known.predicted_sigmas_m(gain)
        then.append(RatedCandidate(kind, candidate, now_m, then_m, known.has_shape))
    then.sort(key=lambda each: float(each.predicted_sigmas_m.max()))
    return [next(each for each in then if each.kind == kind) for kind in dict.fromkeys(each.kind for each in then)]


def find_candidates(graph: Graph, state: State) -> Candidates:
    """Return all candidates for a component; it must have observations."""
    ways = driven_distances_m(graph)
    tracks = tag_tracks(graph, ways)
    drives = drive_paths(graph, state, ways)
    view = view_statistics(drives, len(tracks))
    return Candidates(tracks, drives, view, repeat_drives(ways, tracks), tag_sites(drives, view))


def tag_joint_covariance(solution: Solution, gains: Sequence[InformationGain]) -> JointCovariance:
    """Return the joint covariance of all tags and of the columns that the gains refer to."""
    tags = solution.problem.columns.tags.reshape(-1)
    columns: IntArray = np.unique(np.concatenate([tags[:0], *(gain.columns for gain in gains)]))
    motion = common_motion(solution.state.tags)
    common = np.zeros((len(tags), 0)) if motion is None else motion
    shape = without_common_motion(solution.tag_covariances(), solution.tag_covariance_times(common).T, common)
    block = solution.covariance(np.concatenate([tags, columns]), len(tags))
    return JointCovariance(columns, block[len(tags) :], block[: len(tags)], shape, common)


def _advice_result(graph: Graph, solution: Solution, best: RatedCandidate, component: int) -> AdviceResult:
    wanted, tags = best.candidate, solution.state.tags
    length_m: float | None = None
    if isinstance(wanted, RepeatDrive):
        ends = [wanted.from_tag, wanted.to_tag]
        length_m = float(graph.segments[wanted.segment].odometry.distance_m[wanted.first : wanted.last].sum())
        way = np.unique(np.linspace(wanted.first, wanted.last, _MOST_POINTS).round().astype(int))
        way_m = graph.poses_of(solution.state, wanted.segment)[way, :2]
    else:
        ends, way_m = [int(np.argmin(np.hypot(*(tags - wanted.position_m).T)))], wanted.position_m[None]
    return AdviceResult(
        kind=best.kind,
        component=component,
        run=graph.segments[wanted.segment].name,
        tags=tuple(_tag_name(graph.tags[i]) for i in ends),
        way_m=way_m,
        length_m=length_m,
        worst_tag=_tag_name(graph.tags[int(np.argmax(best.sigmas_m))]),
        sigma_m=float(best.sigmas_m.max()),
        sigma_then_m=float(best.predicted_sigmas_m.max()),
        of_shape=best.of_shape,
    )


def _tag_name(tag: TagKey) -> tuple[str, int, str]:
    return tag.family, tag.tag_id, tag.instance
