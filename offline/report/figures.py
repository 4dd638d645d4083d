"""Data of the report's figures: plain numbers, thinned and rounded, a list for each trace.

Numbers that map.json has too come from its document, so that the two cannot disagree.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import split_camera_parameter
from groundsbot.offline.mapping import Diagnostics, SolvedGroup
from groundsbot.offline.maps import DatumKind
from groundsbot.offline.measurements import most_times
from groundsbot.offline.report.accuracy_texts import frame_name
from groundsbot.offline.report.cells import has_several_families, tag_label
from groundsbot.offline.report.run_styles import RunStyle, run_styles
from groundsbot.offline.report.sentences import advice_sentence, places_of_move, would_help
from groundsbot.offline.report.timeline import events_of, seconds_since, timeline
from groundsbot.offline.self_calibration import OwnedParameter, TimeOffsetSearch

# Points of a trajectory: enough for a screen, zoomed in a few times; fewer where all have more than the last.
_MOST_POINTS: Final = 1500
_LEAST_POINTS: Final = 100
_MOST_POINTS_OF_ALL: Final = 100_000
_MOST_RIVALS: Final = 6  # of a run; and of all runs, since more cannot be distinguished in a picture
_MOST_RIVALS_OF_ALL: Final = 60
_MOST_RUNS_OF_TAG: Final = 12  # as many as the text beside a tag names
# Tags before merging, of all runs; of more, every second tag or fewer is drawn, the same in all runs.
_MOST_TAGS_BEFORE: Final = 20_000
_DECIMALS: Final = 3  # millimetres


def figures(document: dict[str, Any], workings: Diagnostics) -> dict[str, Any]:
    """Return the data of all figures, ready for JSON.

    Args:
        document: document from `map_as_json`.
        workings: workings of the same map.
    """
    styles = _segment_styles(document)
    unit = _residual_rms(workings.components)
    return {
        "components": component_figures(document, workings),
        "timelines": _timelines(workings.components, styles, unit),
        "residual_rms": round(unit, 2),
        "searches": [_search(owned, each) for owned, each in sorted(workings.searches.items())],
    }


def component_figures(document: dict[str, Any], workings: Diagnostics) -> list[dict[str, Any]]:
    """Return the data of the figures of each component, as of `figures`."""
    styles = _segment_styles(document)
    unit = _residual_rms(workings.components)
    return [_component(document, i, solved, workings, styles, unit) for i, solved in enumerate(workings.components)]


def _timelines(components: Sequence[SolvedGroup], styles: dict[str, RunStyle], unit: float) -> list[dict[str, Any]]:
    segments = [segment for solved in components for segment in solved.graph.segments]
    events = events_of(segments)
    most_points = most_times(len(segments))
    found: list[dict[str, Any]] = []
    for index, solved in enumerate(components):
        first = np.searchsorted(segment_of_observation(solved), np.arange(1, len(solved.graph.segments)))
        residuals = np.split(residual_sigmas(solved) / unit, first)
        for segment, own in zip(solved.graph.segments, residuals, strict=True):
            line = timeline(segment, own, events[segment.name], most_points)
            found.append(line | styles[segment.name]._asdict() | {"component": index})
    return found


def _search(owned: OwnedParameter, search: TimeOffsetSearch) -> dict[str, Any]:
    """Return the cost over the time offset of one camera of a robot, which is named where it is one of several."""
    of_camera = owned.owner, split_camera_parameter(owned.name)[1]
    return {
        "camera": f"{', '.join(filter(None, of_camera))}: {search.offset_s:+.3f} s (sigma {search.sigma_s:.3f} s)",
        "offset_s": round(search.offset_s, 4),
        "grid_s": search.grid_s.round(3).tolist(),
        "cost": search.cost.round(2).tolist(),
    }


def _segment_styles(document: dict[str, Any]) -> dict[str, RunStyle]:
    """Return each segment's style, that of its run in map.png."""
    run_of = {run["run"]: run["stretch_of"] or run["run"] for run in document["runs"]}
    styles = run_styles(run_of.values())
    return {segment: styles[run] for segment, run in run_of.items()}


def _residual_rms(components: Sequence[SolvedGroup]) -> float:
    """Return the root mean square of the residuals of all observations of the map, in sigmas; 1 without any.

    It is the unit of residuals in the report. In the solve, sigmas of observations are larger than their scatter, since
    neighbouring observations share errors that do not show in their residuals.
    """
    squares = np.concatenate([residual_sigmas(solved) ** 2 for solved in components])
    return float(np.sqrt(squares.mean())) if squares.any() else 1.0


def residual_sigmas(solved: SolvedGroup) -> FloatArray:
    """Return the residual (M,) of each observation: root mean square of its two whitened coordinates."""
    residual = solved.graph.problem.observations.residual(solved.solution.state)
    return np.asarray(np.sqrt((residual**2).mean(axis=1)))


def segment_of_observation(solved: SolvedGroup) -> IntArray:
    """Return the index (M,) of the segment of each observation, in which they are sorted."""
    return np.searchsorted(solved.graph.first_pose, solved.graph.problem.observations.pose, side="right") - 1


def _tag_observations(solved: SolvedGroup, unit: float) -> list[list[dict[str, Any]]]:
    """Return for each tag of a component a record per segment with the number and residuals of its observations."""
    n_segments, n_tags = len(solved.graph.segments), len(solved.graph.tags)
    sigmas = residual_sigmas(solved) / unit
    cell = solved.graph.problem.observations.tag * n_segments + segment_of_observation(solved)
    count = np.bincount(cell, minlength=n_tags * n_segments).reshape(n_tags, n_segments)
    squares = np.bincount(cell, sigmas**2, n_tags * n_segments).reshape(n_tags, n_segments)
    worst = np.zeros((n_tags, n_segments))
    np.maximum.at(worst.reshape(-1), cell, sigmas)
    return [
        [
            {
                "run": solved.graph.segments[c].name,
                "n": int(count[t, c]),
                "rms": round(float(np.sqrt(squares[t, c] / count[t, c])), 2),
                "worst": round(float(worst[t, c]), 1),
            }
            for c in np.flatnonzero(count[t]).tolist()
        ]
        for t in range(n_tags)
    ]


def _component(
    document: dict[str, Any],
    index: int,
    solved: SolvedGroup,
    workings: Diagnostics,
    styles: dict[str, RunStyle],
    unit: float,
) -> dict[str, Any]:
    runs = [run for run in document["runs"] if run["component"] == index]
    tags = [tag for tag in document["tags"] if tag["component"] == index]
    several = has_several_families(document)
    suspects = {(each["family"], each["tag_id"]): each for each in document["suspect_tags"]}
    own = document["components"][index]
    moves = [
        (places, each["has_ordered_places"])
        for each in suspects.values()
        if len(places := places_of_move(tags, each)) > 1
    ]
    ages = {id(places[i]): age for places, ordered in moves if ordered for i, age in ((0, "old"), (-1, "new"))}
    merged = [
        _trace(run["run"], styles, solved.poses_of(i), segment.stamps_ns)
        for i, (run, segment) in enumerate(zip(runs, solved.graph.segments, strict=True))
    ]
    return {
        "frame": frame_name(own),
        # Relative to the tags' own axes there are no other ellipses than those of the shape.
        "has_shape": own["heading_sigma_rad"] is not None,
        "has_both": own["heading_sigma_rad"] is not None and own.get("datum", {}).get("kind") != DatumKind.TAGS,
        "runs": merged,
        "tags": [
            _tag(tag, observations, suspects, several_families=several) | {"age": ages.get(id(tag))}
            for tag, observations in zip(tags, _tag_observations(solved, unit), strict=True)
        ],
        "moves": [
            {"from": one, "to": other, "ordered": ordered}
            for places, ordered in moves
            for one, other in pairwise(_round_places(places))
        ],
        "survey": _survey(own, tags, several_families=several),
        "rivals": _rivals(document, index, workings, styles),
        "is_merged": len(runs) > 1,
        "before": _unmerged_layers(solved, workings, styles, several_families=several),
        "advice": [
            {"kind": each["kind"], "text": advice_sentence(each, several_families=several)}
            | dict(zip("xy", _round_points(np.array(each["way_m"])), strict=True))
            for each in document["advice"]
            # Joining the components comes first.
            if len(document["components"]) == 1 and would_help(each)
        ],
    }


def _survey(
    component: dict[str, Any], tags: Sequence[dict[str, Any]], *, several_families: bool
) -> list[dict[str, Any]]:
    """Return a record for each place of the survey that is the frame; none where another is."""
    datum = component.get("datum", {})
    found = []
    for place in datum.get("survey", ()):
        tag = place["tag"]
        record = {"label": f"{place['tag_id']}{place['instance']}", "position_m": place["position_m"], "tag": tag}
        if tag is not None:
            off_m = float(np.hypot(*np.subtract(tags[tag]["position_m"][:2], place["position_m"])))
            record |= {
                "label": tag_label(tags[tag], several_families=several_families),
                "off_m": round(off_m, 4),
                "fits": datum["weights"][tag] > 0.0,
            }
        found.append(record)
    return found


def _trace(
    name: str, styles: dict[str, RunStyle], poses: FloatArray, stamps_ns: IntArray | None = None
) -> dict[str, Any]:
    """Return a trajectory and the heading at its start; with stamps (K,) also the seconds since then."""
    most_points = min(_MOST_POINTS, max(_LEAST_POINTS, _MOST_POINTS_OF_ALL // len(styles)))  # a style for each segment
    kept = np.unique(np.append(np.arange(0, len(poses), -(-len(poses) // most_points)), len(poses) - 1))
    x, y = _round_points(poses[kept])
    trace = {"run": name, **styles[name]._asdict(), "x": x, "y": y, "heading_rad": round(float(poses[0, 2]), 4)}
    return trace if stamps_ns is None else trace | {"t_s": seconds_since(stamps_ns[0], stamps_ns[kept])}


def _round_places(tags: Sequence[dict[str, Any]]) -> list[tuple[float, float]]:
    x, y = _round_points(np.array([tag["position_m"] for tag in tags]))
    return list(zip(x, y, strict=True))


def _rivals(
    document: dict[str, Any], index: int, workings: Diagnostics, styles: dict[str, RunStyle]
) -> list[dict[str, Any]]:
    """Return the possible trajectories of runs that are not merged with this component's since that is uncertain.

    Each stands in the first of the two components. Of very many those that share the most tags are returned.
    """
    runs = {run["run"]: run for run in document["runs"]}
    ways = {each.segment.name: each.T_start_base for each in workings.maps}
    found: list[dict[str, Any]] = []
    for each in sorted(document["alignments"], key=lambda each: -each["n_inliers"]):
        if len(found) >= _MOST_RIVALS_OF_ALL:
            break
        here, there = each["from"], each["to"]
        if each["is_sure"] or not each["n_inliers"] or not {here, there} <= runs.keys() & ways.keys():
            continue
        is_turned = runs[there]["component"] < runs[here]["component"]
        if is_turned:
            here, there = there, here
        if runs[here]["component"] != index or runs[there]["component"] == index:
            continue
        transforms = [each["transform"], *(rival["transform"] for rival in each["rivals"])][:_MOST_RIVALS]
        for T_from_to in np.array(transforms):
            T_here_there = se2.inverse(T_from_to) if is_turned else T_from_to
            poses = se2.compose(se2.compose(np.array(runs[here]["T_map_start"]), T_here_there), ways[there])
            found.append(_trace(there, styles, poses) | {"of": len(transforms), "with": here})
    return found


def _tag(
    tag: dict[str, Any],
    observations: Sequence[dict[str, Any]],
    suspects: dict[tuple[str, int], dict[str, Any]],
    *,
    several_families: bool,
) -> dict[str, Any]:
    suspect = suspects.get((tag["family"], tag["tag_id"]))
    return {
        "suspect": None if suspect is None else f"{suspect['kind']} {suspect['evidence']}",
        "label": tag_label(tag, several_families=several_families),
        "family": tag["family"],
        "position_m": [round(value, 6) for value in tag["position_m"][:2]],
        "covariance": _triangle(tag["covariance"]),
        "shape": None if tag["shape_covariance"] is None else _triangle(tag["shape_covariance"]),
        "n": tag["n_observations"],
        "observations": list(observations[:_MOST_RUNS_OF_TAG]),
        "n_runs": len(observations),
    }


def _triangle(covariance: Sequence[Sequence[float | None]]) -> list[float | None]:
    """Return xx, xy and yy of a covariance."""
    (xx, xy), (_, yy) = [row[:2] for row in covariance[:2]]
    return [None if value is None else float(f"{value:.7g}") for value in (xx, xy, yy)]


def _unmerged_layers(
    solved: SolvedGroup, workings: Diagnostics, styles: dict[str, RunStyle], *, several_families: bool
) -> list[dict[str, Any]]:
    """Return each local map as the alignments place it, with its own tags."""
    local_maps = [workings.maps[member] for member in solved.group.members]
    tags = sorted({tag for local_map in local_maps for tag in local_map.tags_m})
    step = -(-sum(len(local_map.tags_m) for local_map in local_maps) // _MOST_TAGS_BEFORE) or 1
    drawn = set(tags[::step])
    layers = []
    for T_frame_start, local_map in zip(solved.group.T_frame_start, local_maps, strict=True):
        own = {tag: place for tag, place in local_map.tags_m.items() if tag in drawn}
        x, y = _round_points(se2.apply(T_frame_start, np.array(list(own.values())).reshape(-1, 2)))
        labels = [tag_label(tag._asdict(), several_families=several_families) for tag in own]
        trace = _trace(local_map.segment.name, styles, se2.compose(T_frame_start, local_map.T_start_base))
        layers.append(trace | {"tags": {"label": labels, "x": x, "y": y}})
    return layers


def _round_points(points: FloatArray) -> tuple[list[float], list[float]]:
    """Return x and y of points (N, 2 or more)."""
    x, y = np.round(points[:, :2], _DECIMALS).T.tolist() if len(points) else ([], [])
    return x, y
