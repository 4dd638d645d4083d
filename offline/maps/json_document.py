"""A map as the JSON document map.json.

docs/formats.md describes every key.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.maps.datum import TagDatum
from groundsbot.offline.maps.fit_results import (
    AlignmentResult,
    OutlierTag,
)
from groundsbot.offline.maps.result import (
    AdviceResult,
    Component,
    FloorSigmas,
    MapResult,
    RunResult,
    TagResult,
)
from groundsbot.offline.maps.shape import Shape, largest_sigmas_m, shape_of

FORMAT_VERSION: Final = 1


def map_as_json(result: MapResult) -> dict[str, Any]:
    """Return the content of map.json: plain data, null where a number is unknown."""
    shapes = [shape_of(component) for component in result.components]
    return {
        "format_version": FORMAT_VERSION,
        "frame": "map",
        "components": [_component_json(*each) for each in zip(result.components, shapes, strict=True)],
        "runs": [_run_json(run, i) for i, component in enumerate(result.components) for run in component.runs],
        "tags": [
            _tag_json(tag, i, None if shape is None else shape.tag_covariances[k])
            for i, (component, shape) in enumerate(zip(result.components, shapes, strict=True))
            for k, tag in enumerate(component.tags)
        ],
        "alignments": [_alignment_json(alignment) for alignment in result.alignments],
        "start_to_start": [
            {
                "a": pair.a,
                "b": pair.b,
                "vector_m": _json_value(pair.vector_m),
                "distance_m": _json_value(pair.distance_m),
                "sigma_m": _json_value(pair.sigma_m),
                "covariance": _json_value(pair.covariance),
            }
            for component in result.components
            for pair in component.start_to_start
        ],
        "noise": result.noise.model_dump() | _floor_json(result.components[0].floor if result.components else None),
        "noise_fit": None if result.noise_fit is None else _json_value(asdict(result.noise_fit)),
        "calibration": [_json_value(vars(entry)) for entry in result.calibration],
        "choices": [_json_value(vars(entry)) for entry in result.choices],
        "robot_numbers": [_json_value(vars(entry)) for entry in result.robot_numbers],
        "measurements": [_json_value(vars(entry)) for entry in result.measurements],
        "checks": [_json_value({"sigmas": entry.sigmas} | vars(entry)) for entry in result.checks],
        "metres": [_json_value(vars(entry)) for entry in result.scale_budgets],
        "suspect_tags": [_outlier_json(suspect) for suspect in result.outliers],
        "advice": [_advice_as_json(advice) for advice in result.advice],
        "warnings": list(result.warnings),
        "losses": list(result.losses),
    }


def _component_json(component: Component, shape: Shape | None) -> dict[str, Any]:
    return {
        "frame_run": component.frame_run,
        "runs": [run.name for run in component.runs],
        "tags": [{"family": t.family, "tag_id": t.tag_id, "instance": t.instance} for t in component.tags],
        "model": component.model,
        "converged": component.converged,
        "cost": _json_value(component.cost),
        "n_residuals": component.n_residuals,
        "floor": _floor_json(component.floor) or None,
        "heading_sigma_rad": None if shape is None else _json_value(shape.heading_sigma_rad),
        "sigma_factor": _json_value(component.sigma_factor),
        "misfit": None if component.misfit is None else _json_value(asdict(component.misfit)),
    } | _datum_json(component.datum)


def _datum_json(datum: TagDatum | None) -> dict[str, Any]:
    if datum is None:
        return {}
    own = {"kind": datum.kind, "weights": _json_value(datum.weights)}
    survey = {"survey": [_json_value(vars(each)) for each in datum.survey]} if datum.survey else {}
    return {"datum": own | survey}


def _floor_json(floor: FloorSigmas | None) -> dict[str, Any]:
    return {} if floor is None else asdict(floor)


def _run_json(run: RunResult, component: int) -> dict[str, Any]:
    return {
        "run": run.name,
        "log": str(run.log),
        "robot": run.robot_id,
        "T_map_start": _json_value(run.T_map_start),
        "covariance": _json_value(run.covariance),
        "n_keyframes": run.n_keyframes,
        "distance_m": _json_value(run.distance_m),
        "run_id": run.run_id,
        "stretch_of": None if run.run == run.name else run.run,
        "component": component,
        "T_base_camera": None if run.T_base_camera is None else _json_value(run.T_base_camera),
        **_cameras_json(run),
    }


def _cameras_json(run: RunResult) -> dict[str, Any]:
    cameras = {name: _json_value(T_base_camera) for name, T_base_camera in run.T_base_cameras.items()}
    return {"T_base_cameras": cameras} if cameras else {}


def _tag_json(tag: TagResult, component: int, shape: FloatArray | None) -> dict[str, Any]:
    return {
        "family": tag.family,
        "tag_id": tag.tag_id,
        "instance": tag.instance,
        "size_m": _json_value(tag.size_m),
        "position_m": _json_value(tag.position_m if tag.pose is None else np.append(tag.position_m, tag.pose.height_m)),
        "quaternion_xyzw": None if tag.pose is None else _json_value(tag.pose.quaternion_xyzw),
        "covariance": _json_value(tag.covariance if tag.pose is None else tag.pose.covariance[:3, :3]),
        "pose_covariance": None if tag.pose is None else _json_value(tag.pose.covariance),
        "sigma_m": _sigma_json(tag.covariance),
        "shape_covariance": _json_value(shape),
        "shape_sigma_m": None if shape is None else _sigma_json(shape),
        "sigma_factor": _json_value(tag.sigma_factor),
        "n_observations": tag.n_observations,
        "runs": list(tag.runs),
        "component": component,
    }


def _sigma_json(covariance: FloatArray) -> float | None:
    """Return the standard deviation along the worst direction."""
    sigma_m: float | None = _json_value(largest_sigmas_m(covariance[None]).item())
    return sigma_m


def _alignment_json(alignment: AlignmentResult) -> dict[str, Any]:
    return {
        "from": alignment.from_run,
        "to": alignment.to_run,
        "transform": _json_value(alignment.T_from_to),
        "n_shared": alignment.n_shared,
        "n_inliers": alignment.n_inliers,
        "inlier_rmse_m": _json_value(alignment.inlier_rmse_m),
        "outliers": _tag_names_json(alignment.outliers),
        "is_sure": alignment.is_accepted,
        "is_weak": alignment.is_weak,
        "covariance": None if alignment.covariance is None else _json_value(alignment.covariance),
        "rivals": [
            {
                "transform": _json_value(rival.T_from_to),
                "n_inliers": len(rival.tags),
                "tags": _tag_names_json(rival.tags),
            }
            for rival in alignment.alternatives
        ],
    }


def _outlier_json(suspect: OutlierTag) -> dict[str, Any]:
    entry = {name: getattr(suspect, name) for name in ("family", "tag_id", "kind", "evidence", "has_ordered_places")}
    other = {} if suspect.swapped_with is None else {"swapped_with": suspect.swapped_with}
    return entry | {"runs": list(suspect.runs)} | other


def _advice_as_json(advice: AdviceResult) -> dict[str, Any]:
    """Return an entry of `advice` in map.json."""
    entry = {name: _json_value(value) for name, value in vars(advice).items() if name not in ("tags", "worst_tag")}
    return entry | {"tags": [_tag_key_json(tag) for tag in advice.tags], "worst_tag": _tag_key_json(advice.worst_tag)}


def _tag_key_json(tag: tuple[str, int, str]) -> dict[str, Any]:
    return dict(zip(("family", "tag_id", "instance"), tag, strict=True))


def _tag_names_json(tags: Sequence[tuple[str, int]]) -> list[dict[str, Any]]:
    return [{"family": family, "tag_id": tag_id} for family, tag_id in tags]


def _json_value(value: Any) -> Any:  # noqa: ANN401 - what JSON holds, nested to any depth
    """Return numbers, texts, nested lists and mappings for JSON, with null for NaN."""
    if isinstance(value, dict):
        return {name: _json_value(entry) for name, entry in value.items()}
    if isinstance(value, tuple | list):
        return [_json_value(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return [_json_value(entry) for entry in value] if value.ndim else _json_value(float(value))
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
