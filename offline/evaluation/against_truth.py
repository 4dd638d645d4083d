"""Comparison of a map with ground truth: its errors, and whether its covariances predict them (`nees`).

Truth is expressed in the true start pose of the frame's run, so figures without "aligned" need no alignment. Where tags
hold the frame, it is aligned with those of them that it has, and the covariances are taken relative to the same tags.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.linalg import null_space

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import fit_transform, se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation.errors import ComponentErrors, MapErrors, StartError, TagError
from groundsbot.offline.evaluation.nees import link_errors, nees_per_dim
from groundsbot.offline.evaluation.truth import TrueRun, Truth
from groundsbot.offline.maps import (
    Component,
    MapResult,
    RunResult,
    TagDatum,
    TagResult,
    datum_centre,
    motion_jacobian,
    relative_to_tags,
)


def evaluate(result: MapResult, truth: Truth) -> MapErrors:
    """Return the errors of a map.

    Raises:
        OfflineError: the truth lacks the run or the tags that define the largest component's frame.
    """
    components = []
    for index, component in enumerate(result.components):
        frame = _true_frame(component, truth)
        if frame is None and index == 0:
            raise OfflineError(_missing_frame(component, truth))
        components.append(
            _without_truth(component)
            if frame is None
            else _evaluate(_relative_to_known(component, truth), truth, frame)
        )
    return MapErrors(tuple(components))


def _missing_frame(component: Component, truth: Truth) -> str:
    if component.datum is not None:
        return (
            "truth: tags has fewer than two of those that hold the map's frame, or all in one place; give the "
            "truth.json of these drives"
        )
    return (
        f"truth: runs has no {component.frame_run!r} at its start's time, and the map's frame is that start; "
        f"it has {', '.join(sorted(truth.runs)) or 'no runs'}; give the truth.json of these drives"
    )


def _true_frame(component: Component, truth: Truth) -> FloatArray | None:
    """Return T_world_map: the true start of the frame's run, or from the true tags that hold the frame."""
    if component.datum is None:
        first = next(run for run in component.runs if run.name == component.frame_run)
        return _true_start(first, truth)
    weights = _known_weights(component, component.datum, truth)
    held = np.flatnonzero(weights)
    found = np.array([tag.position_m for tag in component.tags])
    if datum_centre(found, weights) is None:
        return None
    world = np.array([truth.tags_m[_tag_name(component.tags[i])] for i in held])
    return fit_transform(world, found[held], weights[held])


def _known_weights(component: Component, datum: TagDatum, truth: Truth) -> FloatArray:
    """Return the datum's weights (T,), 0 for tags that the truth lacks."""
    return np.where([_is_in_truth(truth, tag) for tag in component.tags], datum.weights, 0.0)


def _relative_to_known(component: Component, truth: Truth) -> Component:
    """Return a component whose frame tags hold, relative to those of them that the truth has."""
    if component.datum is None:
        return component
    weights = _known_weights(component, component.datum, truth)
    if (weights == component.datum.weights).all():
        return component
    joint, first = relative_to_tags(component, weights), 3 * len(component.runs)
    rows = [slice(i, i + 2) for i in range(first, len(joint), 2)]
    tags = tuple(replace(tag, covariance=joint[own, own]) for tag, own in zip(component.tags, rows, strict=True))
    return replace(component, tags=tags, joint_covariance=joint, datum=replace(component.datum, weights=weights))


def _true_start(run: RunResult, truth: Truth) -> FloatArray | None:
    true_run = truth.runs.get(run.run)
    if true_run is None:
        return None
    poses, covered = true_run.poses_at(run.stamps_ns[:1])
    return poses[0] if covered[0] else None


def _without_truth(component: Component) -> ComponentErrors:
    note = f"the truth lacks {component.frame_name}; this component is not evaluated"
    runs = tuple(run.name for run in component.runs)
    return ComponentErrors(
        component.frame_run,
        component.frame_name,
        runs,
        len(component.tags),
        (),
        (),
        None,
        None,
        None,
        None,
        None,
        (note,),
    )


def _evaluate(component: Component, truth: Truth, T_world_map: FloatArray) -> ComponentErrors:
    notes = _notes(component, truth)
    places = _start_places(component, truth, T_world_map)
    starts = tuple(_start_error(a, b, places) for a, b in combinations(places, 2))
    known = [i for i, tag in enumerate(component.tags) if _is_in_truth(truth, tag)]
    tags = [component.tags[i] for i in known]
    found = np.array([tag.position_m for tag in tags]).reshape(-1, 2)
    world = np.array([truth.tags_m[_tag_name(tag)] for tag in tags]).reshape(-1, 2)
    true = se2.apply(se2.inverse(T_world_map), world)
    errors = found - true
    nees_start, nees_tags = _nees(component, places, known, true)
    for name, value, wanted in (("tags", nees_tags, len(tags)), ("start", nees_start, len(starts))):
        if wanted and value is None:
            notes.append(f"nees_{name}_per_dim: the covariance is not positive definite, so there is no figure")
    return ComponentErrors(
        frame_run=component.frame_run,
        frame_name=component.frame_name,
        runs=tuple(run.name for run in component.runs),
        n_tags=len(component.tags),
        starts=starts,
        tags=tuple(_tag_error(tag, error) for tag, error in zip(tags, errors, strict=True)),
        tags_rmse_m=_rms(errors),
        tags_rmse_aligned_m=_rms(se2.apply(fit_transform(true, found), found) - true) if len(tags) > 1 else None,
        trajectory_rmse_m=_rms(_trajectory_errors(component.runs, truth, T_world_map)),
        nees_tags_per_dim=nees_tags,
        nees_start_per_dim=nees_start,
        notes=tuple(notes),
    )


def _start_places(
    component: Component, truth: Truth, T_world_map: FloatArray
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the estimated and true start (2,) of each run, without later segments, as they do not begin a drive."""
    places = {}
    for run in component.runs:
        T_world_start = _true_start(run, truth) if run.run == run.name else None
        if T_world_start is not None:
            places[run.name] = run.T_map_start[:2], se2.between(T_world_map, T_world_start)[:2]
    return places


def _nees(
    component: Component,
    places: Mapping[str, tuple[FloatArray, FloatArray]],
    known: Sequence[int],
    true_tags_m: FloatArray,
) -> tuple[float | None, float | None]:
    """Return the NEES of all starts jointly relative to the frame's, and of all tags (indices `known`) jointly."""
    names = [run.name for run in component.runs]
    starts = [name for name in places if name != component.frame_run]
    rows = [3 * names.index(name) + axis for name in starts for axis in (0, 1)]
    rows += [3 * len(names) + 2 * i + axis for i in known for axis in (0, 1)]
    covariance = component.joint_covariance[np.ix_(rows, rows)]
    found_m = np.array([places[name][0] for name in starts] + [component.tags[i].position_m for i in known])
    true_m = np.concatenate([np.array([places[name][1] for name in starts]).reshape(-1, 2), true_tags_m])
    if not len(rows) or not np.isfinite(covariance).all():
        return None, None
    places_m = np.array([tag.position_m for tag in component.tags]).reshape(-1, 2)
    centre_m = None if component.datum is None else datum_centre(places_m, component.datum.weights)
    origin_m = np.zeros(2) if centre_m is None else centre_m  # of all places, the one without error
    errors = link_errors(found_m - origin_m, true_m - origin_m, covariance)
    n = len(starts)
    return (
        nees_per_dim(errors[:n].reshape(-1), covariance[: 2 * n, : 2 * n]),
        _nees_of_tags(component, known, errors[n:].reshape(-1), covariance[2 * n :, 2 * n :]),
    )


def _nees_of_tags(
    component: Component, known: Sequence[int], error: FloatArray, covariance: FloatArray
) -> float | None:
    """Return the NEES of tags; where they hold the frame, without the three dimensions that this leaves no error."""
    if component.datum is None:
        return nees_per_dim(error, covariance)
    rows = 3 * len(component.runs) + (2 * np.array(known)[:, None] + np.arange(2)).reshape(-1)
    weights = np.repeat(component.datum.weights[known], 2)
    fixed = weights[:, None] * motion_jacobian(component, component.tags[known[0]].position_m)[rows]
    others = null_space(fixed.T)
    return nees_per_dim(others.T @ error, others.T @ covariance @ others)


def _start_error(a: str, b: str, places: dict[str, tuple[FloatArray, FloatArray]]) -> StartError:
    found = places[b][0] - places[a][0]
    true = places[b][1] - places[a][1]
    return StartError(
        a,
        b,
        distance_m=float(np.linalg.norm(found)),
        true_distance_m=float(np.linalg.norm(true)),
        vector_error_m=float(np.linalg.norm(found - true)),
    )


def _trajectory_errors(runs: Iterable[RunResult], truth: Truth, T_world_map: FloatArray) -> FloatArray:
    """Return position errors (K, 2) of all keyframes that the truth covers."""
    errors = [np.empty((0, 2))]
    for run in runs:
        true_run = truth.runs.get(run.run)
        if true_run is not None:
            T_world_base, covered = true_run.poses_at(run.stamps_ns)
            T_map_base = se2.between(T_world_map, T_world_base)
            errors.append((run.T_map_base - T_map_base)[covered, :2])
    return np.concatenate(errors)


def _notes(component: Component, truth: Truth) -> list[str]:
    """Return a line for each part of the map that the truth lacks."""
    notes = []
    unknown_runs = [run.name for run in component.runs if run.run not in truth.runs]
    if unknown_runs:
        notes.append(f"not in the truth, left out: runs {', '.join(unknown_runs)}")
    late = sum(_n_outside_truth(run, truth.runs[run.run]) for run in component.runs if run.run in truth.runs)
    if late:
        notes.append(f"{late} keyframes lie outside the truth's time, left out of trajectory_rmse_m")
    unknown_tags = [tag.full_label for tag in component.tags if not _is_in_truth(truth, tag)]
    if unknown_tags:
        notes.append(f"not in the truth, or there more than once, left out: tags {', '.join(unknown_tags)}")
    return notes


def _n_outside_truth(run: RunResult, true_run: TrueRun) -> int:
    return int((~true_run.poses_at(run.stamps_ns)[1]).sum())


def _tag_name(tag: TagResult) -> tuple[str, int, str]:
    return tag.family, tag.tag_id, tag.instance


def _is_in_truth(truth: Truth, tag: TagResult) -> bool:
    return _tag_name(tag) in truth.tags_m and _tag_name(tag) not in truth.ambiguous


def _tag_error(tag: TagResult, error_m: FloatArray) -> TagError:
    return TagError(
        tag.family,
        tag.tag_id,
        tag.instance,
        float(np.linalg.norm(error_m)),
        float(np.sqrt(np.trace(tag.covariance))),
    )


def _rms(errors_m: FloatArray) -> float | None:
    """Return the root mean square length of errors (N, 2); None if there are none."""
    return float(np.sqrt((errors_m**2).sum(axis=1).mean())) if len(errors_m) else None
