"""A map's files, written and read: map.json, map.npz, tags.csv and a trajectory for each run.

docs/formats.md describes every key and column.
"""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from calib.arrays import FloatArray
from calib.errors import CalibError
from calib.files import written_whole
from calib.noise import NoiseParameters
from offline.errors import OfflineError
from offline.kept import KeptChain, arrays_of, calibration_from, chain_from
from offline.map_model import MapModel
from offline.result import (
    AdviceResult,
    AlignmentResult,
    CalibrationResult,
    CheckResult,
    Component,
    FittedNoise,
    FittedParameter,
    GraphEdges,
    MapResult,
    MeasurementResult,
    MetreResult,
    RivalResult,
    RunResult,
    StartToStart,
    SuspectTag,
    TagPose,
    TagResult,
)
from offline.trajectory_file import read_tum, write_tum

FORMAT_VERSION: Final = 1
JSON_FILE: Final = "map.json"
ARRAYS_FILE: Final = "map.npz"
TAGS_FILE: Final = "tags.csv"
TAG_COLUMNS: Final = (
    "tag_id",
    "x_m",
    "y_m",
    "z_m",
    "yaw_rad",
    "sigma_x_m",
    "sigma_y_m",
    "n_observations",
    "runs",
    "family",
    "instance",
    "covariance_xy_m2",
)


def write_map(result: MapResult, folder: Path) -> None:
    """Writes all files of a map into an existing folder; the same bytes for the same result.

    Raises:
        OSError: the folder is missing or not writable.
    """
    text = json.dumps(map_as_json(result), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    with written_whole(folder / JSON_FILE) as partial:
        partial.write_text(text, encoding="utf-8")
    with written_whole(folder / ARRAYS_FILE) as partial, partial.open("wb") as stream:
        np.savez(stream, **_arrays(result))
    with written_whole(folder / TAGS_FILE) as partial:
        partial.write_text(tags_csv(result.components), encoding="utf-8")
    for run in result.runs:
        write_tum(folder / f"{run.name}.tum", run.stamps_ns, run.T_map_base)


def read_map(folder: Path) -> MapResult:
    """Reads what `write_map` wrote, with the full precision of map.npz where it has it.

    Raises:
        OfflineError: a file is missing, damaged, or of a format that this program does not know.
    """
    path = folder / JSON_FILE
    data = _read_json(path)
    version = data.get("format_version")
    if version != FORMAT_VERSION:
        raise OfflineError(
            f"{path}: format_version is {version!r}, this program reads {FORMAT_VERSION}; make the map again"
        )
    try:
        with np.load(folder / ARRAYS_FILE, allow_pickle=False) as arrays:
            components = tuple(_component(data, index, arrays, folder) for index in range(len(data["components"])))
            kept = _kept(arrays)
        return MapResult(
            components=components,
            alignments=tuple(_alignment(entry) for entry in data["alignments"]),
            noise=NoiseParameters.model_validate(data["noise"]),
            noise_fit=_noise_fit(data.get("noise_fit")),
            calibration=tuple(CalibrationResult(**entry) for entry in data["calibration"]),
            measurements=tuple(_measurement(entry) for entry in data["measurements"]),
            checks=tuple(_check(entry) for entry in data["checks"]),
            metres=tuple(MetreResult(**entry) for entry in data["metres"]),
            warnings=tuple(data["warnings"]),
            losses=tuple(data.get("losses", ())),
            suspects=tuple(SuspectTag(**each | {"runs": tuple(each["runs"])}) for each in data["suspect_tags"]),
            advice=tuple(_advice(entry) for entry in data.get("advice", ())),
            kept=kept,
        )
    except OSError as error:
        raise OfflineError(f"{error.filename}: cannot be read ({error.strerror}); make the map again") from error
    except (KeyError, IndexError, TypeError, ValueError, CalibError) as error:
        raise OfflineError(
            f"{folder}: the map's files are damaged or incomplete ({error}); make the map again"
        ) from error


def map_as_json(result: MapResult) -> dict[str, Any]:
    """What map.json holds: plain data, null where a number is not known."""
    return {
        "format_version": FORMAT_VERSION,
        "frame": "map",
        "components": [_component_json(component) for component in result.components],
        "runs": [_run_json(run, i) for i, component in enumerate(result.components) for run in component.runs],
        "tags": [_tag_json(tag, i) for i, component in enumerate(result.components) for tag in component.tags],
        "alignments": [_alignment_json(alignment) for alignment in result.alignments],
        "start_to_start": [
            {
                "a": pair.a,
                "b": pair.b,
                "vector_m": _plain(pair.vector_m),
                "distance_m": _plain(pair.distance_m),
                "sigma_m": _plain(pair.sigma_m),
                "covariance": _plain(pair.covariance),
            }
            for component in result.components
            for pair in component.start_to_start
        ],
        "noise": result.noise.model_dump(),
        "noise_fit": None if result.noise_fit is None else asdict(result.noise_fit),
        "calibration": [{name: _plain(value) for name, value in vars(entry).items()} for entry in result.calibration],
        "measurements": [{name: _plain(value) for name, value in vars(entry).items()} for entry in result.measurements],
        "checks": [{"sigmas": _plain(entry.sigmas)} | vars(entry) for entry in result.checks],
        "metres": [vars(entry) for entry in result.metres],
        "suspect_tags": [_suspect_json(suspect) for suspect in result.suspects],
        "advice": [advice_as_json(advice) for advice in result.advice],
        "warnings": list(result.warnings),
        "losses": list(result.losses),
    }


def _component_json(component: Component) -> dict[str, Any]:
    return {
        "frame_run": component.frame_run,
        "runs": [run.name for run in component.runs],
        "tags": [{"family": t.family, "tag_id": t.tag_id, "instance": t.instance} for t in component.tags],
        "model": component.model,
        "cost": _plain(component.cost),
        "n_residuals": component.n_residuals,
    }


def _run_json(run: RunResult, component: int) -> dict[str, Any]:
    return {
        "run": run.name,
        "log": str(run.log),
        "robot": run.robot_id,
        "T_map_start": _plain(run.T_map_start),
        "covariance": _plain(run.covariance),
        "n_keyframes": run.n_keyframes,
        "distance_m": _plain(run.distance_m),
        "run_id": run.run_id,
        "stretch_of": None if run.run == run.name else run.run,
        "component": component,
        "T_base_camera": None if run.T_base_camera is None else _plain(run.T_base_camera),
    }


def _tag_json(tag: TagResult, component: int) -> dict[str, Any]:
    return {
        "family": tag.family,
        "tag_id": tag.tag_id,
        "instance": tag.instance,
        "size_m": _plain(tag.size_m),
        "position_m": _plain(tag.position_m if tag.pose is None else np.append(tag.position_m, tag.pose.height_m)),
        "quaternion_xyzw": None if tag.pose is None else _plain(tag.pose.quaternion_xyzw),
        "covariance": _plain(tag.covariance if tag.pose is None else tag.pose.covariance[:3, :3]),
        "pose_covariance": None if tag.pose is None else _plain(tag.pose.covariance),
        "n_observations": tag.n_observations,
        "runs": list(tag.runs),
        "component": component,
    }


def _alignment_json(alignment: AlignmentResult) -> dict[str, Any]:
    return {
        "from": alignment.from_run,
        "to": alignment.to_run,
        "transform": _plain(alignment.T_from_to),
        "n_shared": alignment.n_shared,
        "n_inliers": alignment.n_inliers,
        "inlier_rmse_m": _plain(alignment.inlier_rmse_m),
        "outliers": _tag_names_json(alignment.outliers),
        "is_sure": alignment.is_sure,
        "rivals": [
            {"transform": _plain(rival.T_from_to), "n_inliers": len(rival.tags), "tags": _tag_names_json(rival.tags)}
            for rival in alignment.rivals
        ],
    }


def _suspect_json(suspect: SuspectTag) -> dict[str, Any]:
    entry = {name: getattr(suspect, name) for name in ("family", "tag_id", "kind", "evidence")}
    other = {} if suspect.swapped_with is None else {"swapped_with": suspect.swapped_with}
    return entry | {"runs": list(suspect.runs)} | other


def advice_as_json(advice: AdviceResult) -> dict[str, Any]:
    """An entry of `advice` in map.json."""
    entry = {name: _plain(value) for name, value in vars(advice).items() if name not in ("tags", "worst_tag")}
    return entry | {"tags": [_tag_key_json(tag) for tag in advice.tags], "worst_tag": _tag_key_json(advice.worst_tag)}


def _tag_key_json(tag: tuple[str, int, str]) -> dict[str, Any]:
    return dict(zip(("family", "tag_id", "instance"), tag, strict=True))


def _tag_names_json(tags: Sequence[tuple[str, int]]) -> list[dict[str, Any]]:
    return [{"family": family, "tag_id": tag_id} for family, tag_id in tags]


def _plain(value: FloatArray | float | int | str | None) -> Any:  # noqa: ANN401 - nested lists of any depth
    """Numbers and nested lists for JSON, which has no NaN: null instead."""
    if isinstance(value, np.ndarray):
        return [_plain(entry) for entry in value] if value.ndim else _plain(float(value))
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value


def _arrays(result: MapResult) -> dict[str, Any]:
    """Full precision and the joint covariances: what localising in, extending or judging the map needs."""
    arrays: dict[str, Any] = {"format_version": np.int64(FORMAT_VERSION)}
    for index, component in enumerate(result.components):
        tags, key = component.tags, f"component{index}_"
        arrays |= {
            f"{key}runs": np.array([run.name for run in component.runs], dtype=np.str_),
            f"{key}T_map_start": np.array([run.T_map_start for run in component.runs]).reshape(-1, 3),
            f"{key}start_stamps_ns": np.array([run.stamps_ns[0] for run in component.runs], dtype=np.int64),
            f"{key}tag_families": np.array([tag.family for tag in tags], dtype=np.str_),
            f"{key}tag_ids": np.array([tag.tag_id for tag in tags], dtype=np.int64),
            f"{key}tag_instances": np.array([tag.instance for tag in tags], dtype=np.str_),
            f"{key}tag_positions_m": np.array([tag.position_m for tag in tags]).reshape(-1, 2),
            f"{key}joint_covariance": component.joint_covariance,
        }
        if component.edges is not None:
            arrays |= {f"{key}edges_{name}": value for name, value in vars(component.edges).items()}
        if component.calibration is not None:
            arrays |= arrays_of(component.calibration, f"{key}calibration_")
    for index, kept in enumerate(result.kept):
        arrays |= arrays_of(kept, f"run{index}_")
    return arrays


def tags_csv(components: Sequence[Component]) -> str:
    """The table of tags, as tags.csv has it."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(TAG_COLUMNS)
    for component in components:
        for tag in component.tags:
            writer.writerow(_tag_row(tag))
    return stream.getvalue()


def _tag_row(tag: TagResult) -> Sequence[str | int]:
    sigma_x_m, sigma_y_m = np.sqrt(np.diag(tag.covariance))
    return (
        tag.tag_id,
        _decimal(tag.position_m[0]),
        _decimal(tag.position_m[1]),
        "" if tag.pose is None else _decimal(tag.pose.height_m),
        "" if tag.pose is None else _decimal(tag.pose.yaw_rad),
        _decimal(sigma_x_m),
        _decimal(sigma_y_m),
        tag.n_observations,
        " ".join(tag.runs),
        tag.family,
        tag.instance,
        "" if not np.isfinite(tag.covariance[0, 1]) else f"{tag.covariance[0, 1]:.9g}",
    )


def _decimal(value: float) -> str:
    return f"{value:.6f}" if np.isfinite(value) else ""


def _read_json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OfflineError(f"{path}: cannot be read ({error.strerror}); give the folder that `map -o` wrote") from error
    except ValueError as error:
        raise OfflineError(f"{path}: is not JSON ({error}); make the map again") from error
    if not isinstance(data, dict):
        raise OfflineError(f"{path}: holds no object; make the map again")
    return data


def _component(data: dict[str, Any], index: int, arrays: Mapping[str, Any], folder: Path) -> Component:
    entry, key = data["components"][index], f"component{index}_"
    starts, positions = arrays[f"{key}T_map_start"], arrays[f"{key}tag_positions_m"]
    run_entries = [each for each in data["runs"] if each["component"] == index]
    tag_entries = [each for each in data["tags"] if each["component"] == index]
    runs = tuple(_run(each, start, folder) for each, start in zip(run_entries, starts, strict=True))
    tags = tuple(replace(_tag(each), position_m=place) for each, place in zip(tag_entries, positions, strict=True))
    joint = arrays[f"{key}joint_covariance"]
    if joint.shape != (3 * len(runs) + 2 * len(tags),) * 2:
        raise ValueError(f"{key}joint_covariance has the shape {joint.shape}")
    names = {run.name for run in runs}
    return Component(
        frame_run=entry["frame_run"],
        runs=runs,
        tags=tags,
        joint_covariance=joint,
        cost=_number(entry["cost"]),
        n_residuals=entry["n_residuals"],
        start_to_start=tuple(
            StartToStart(pair["a"], pair["b"], _array(pair["vector_m"]), _array(pair["covariance"]))
            for pair in data["start_to_start"]
            if pair["a"] in names
        ),
        edges=_edges(f"{key}edges_", arrays),
        model=MapModel(entry.get("model", MapModel.FLOOR)),
        calibration=calibration_from(arrays, f"{key}calibration_"),
    )


def _kept(arrays: Mapping[str, Any]) -> tuple[KeptChain, ...]:
    """All that there are; none in a map of an older program."""
    found: list[KeptChain] = []
    while (kept := chain_from(arrays, f"run{len(found)}_")) is not None:
        found.append(kept)
    return tuple(found)


def _edges(key: str, arrays: Mapping[str, Any]) -> GraphEdges | None:
    names = [each.name for each in fields(GraphEdges)]
    if f"{key}{names[0]}" not in arrays:
        return None
    return GraphEdges(**{name: arrays[f"{key}{name}"] for name in names})


def _run(entry: dict[str, Any], T_map_start: FloatArray, folder: Path) -> RunResult:
    stamps_ns, T_map_base = read_tum(folder / f"{entry['run']}.tum")
    return RunResult(
        name=entry["run"],
        run=entry["stretch_of"] or entry["run"],
        log=Path(entry["log"]),
        robot_id=entry["robot"],
        run_id=entry["run_id"],
        T_map_start=T_map_start,
        covariance=_array(entry["covariance"]),
        stamps_ns=stamps_ns,
        T_map_base=T_map_base,
        distance_m=_number(entry["distance_m"]),
        T_base_camera=None if entry["T_base_camera"] is None else _array(entry["T_base_camera"]),
    )


def _tag(entry: dict[str, Any]) -> TagResult:
    return TagResult(
        family=entry["family"],
        tag_id=entry["tag_id"],
        instance=entry["instance"],
        size_m=entry["size_m"],
        position_m=_array(entry["position_m"])[:2],
        covariance=_array(entry["covariance"])[:2, :2],
        n_observations=entry["n_observations"],
        runs=tuple(entry["runs"]),
        pose=_tag_pose(entry),
    )


def _tag_pose(entry: dict[str, Any]) -> TagPose | None:
    if entry["quaternion_xyzw"] is None:
        return None
    height_m = _number(entry["position_m"][2])
    return TagPose(height_m, _array(entry["quaternion_xyzw"]), _array(entry["pose_covariance"]))


def _alignment(entry: dict[str, Any]) -> AlignmentResult:
    return AlignmentResult(
        from_run=entry["from"],
        to_run=entry["to"],
        T_from_to=_array(entry["transform"]),
        n_shared=entry["n_shared"],
        n_inliers=entry["n_inliers"],
        inlier_rmse_m=_number(entry["inlier_rmse_m"]),
        outliers=_tag_names(entry["outliers"]),
        is_sure=entry["is_sure"],
        rivals=tuple(RivalResult(_array(rival["transform"]), _tag_names(rival["tags"])) for rival in entry["rivals"]),
    )


def _measurement(entry: dict[str, Any]) -> MeasurementResult:
    in_map = entry["in_map"]
    arrays = {"measured": _array(entry["measured"]), "sigma": _array(entry["sigma"])}
    return MeasurementResult(**entry | arrays | {"in_map": None if in_map is None else _array(in_map)})


def _check(entry: dict[str, Any]) -> CheckResult:
    return CheckResult(**{name: value for name, value in entry.items() if name != "sigmas"})


def _noise_fit(entry: dict[str, Any] | None) -> FittedNoise | None:
    if entry is None:
        return None
    parameters = tuple(FittedParameter(**parameter) for parameter in entry["parameters"])
    return FittedNoise(
        parameters,
        shared_range=_number(entry["shared_range"]),
        shared_bearing=_number(entry["shared_bearing"]),
        runs=tuple(entry["runs"]),
        contradicting=tuple(entry["contradicting"]),
    )


def _advice(entry: dict[str, Any]) -> AdviceResult:
    tags = [(each["family"], each["tag_id"], each["instance"]) for each in (*entry["tags"], entry["worst_tag"])]
    named = {"tags": tuple(tags[:-1]), "worst_tag": tags[-1], "way_m": _array(entry["way_m"]).reshape(-1, 2)}
    return AdviceResult(**entry | named)


def _tag_names(entries: Sequence[dict[str, Any]]) -> tuple[tuple[str, int], ...]:
    return tuple((entry["family"], entry["tag_id"]) for entry in entries)


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _array(values: Sequence[Any]) -> FloatArray:
    return np.array(values, dtype=np.float64)  # null becomes NaN
