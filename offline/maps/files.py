"""A map's files, written and read: map.json, map.npz, tags.csv and a trajectory for each run.

docs/formats.md describes every key and column.
"""

import json
import zlib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import FloatArray, StrPath, atomic_write
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import log_path, open_arrays
from groundsbot.offline.maps.archive import ArchivedSegment, arrays_of, calibration_from, segment_from
from groundsbot.offline.maps.fit_results import MeasurementResult, OutlierTag
from groundsbot.offline.maps.json_document import FORMAT_VERSION, map_as_json
from groundsbot.offline.maps.json_entries import (
    advice_from,
    alignment_from,
    array_from,
    datum_from,
    floor_from,
    misfit_from,
    noise_fit_from,
    noise_from,
    number_from,
    result_from,
    tag_from,
)
from groundsbot.offline.maps.model import JSON_FILE, MapModel
from groundsbot.offline.maps.parameter_results import (
    CalibrationChoice,
    CalibrationResult,
    ConsistencyCheck,
    RobotNumber,
    ScaleBudget,
)
from groundsbot.offline.maps.result import Component, GraphEdges, MapResult, RunResult, StartToStart
from groundsbot.offline.maps.tags_table import tags_csv
from groundsbot.offline.maps.tum import read_tum, write_tum

ARRAYS_FILE: Final = "map.npz"
TAGS_FILE: Final = "tags.csv"
# Errors of reading a damaged map.json or map.npz.
_DAMAGE_ERRORS: Final = (
    AttributeError,
    BadZipFile,
    CalibError,
    EOFError,
    IndexError,
    KeyError,
    OverflowError,
    TypeError,
    ValueError,
    zlib.error,
)


def write_map(result: MapResult, folder: StrPath) -> None:
    """Write all files of a map into an existing folder; the same result gives the same bytes.

    Raises:
        OSError: the folder is missing or not writable.
    """
    folder = Path(folder)
    text = json.dumps(map_as_json(result), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(folder / JSON_FILE) as partial:
        partial.write_text(text, encoding="utf-8")
    with atomic_write(folder / ARRAYS_FILE) as partial, partial.open("wb") as stream:
        np.savez(stream, **_arrays(result))
    with atomic_write(folder / TAGS_FILE) as partial:
        partial.write_text(tags_csv(result.components), encoding="utf-8")
    for run in result.runs:
        write_tum(folder / f"{run.name}.tum", run.stamps_ns, run.T_map_base)


def read_map(folder: StrPath) -> MapResult:
    """Read what `write_map` wrote, with the full precision of map.npz where available.

    Raises:
        OfflineError: a file is missing, damaged, or of a format that this program does not know.
    """
    folder = Path(folder)
    path = folder / JSON_FILE
    data = _read_json(folder)
    version = data.get("format_version")
    if version != FORMAT_VERSION:
        raise OfflineError(
            f"{path}: format_version is {version!r}, this program reads {FORMAT_VERSION}; make the map again"
        )
    try:
        with open_arrays(folder / ARRAYS_FILE) as arrays:
            if not data["components"]:
                raise ValueError("no components")
            if len({each["run"] for each in data["runs"]}) < len(data["runs"]):
                raise ValueError("a run is there twice")
            components = tuple(_component(data, index, arrays, folder) for index in range(len(data["components"])))
            kept = _archived_segments(arrays)
        return MapResult(
            components=components,
            alignments=tuple(alignment_from(entry) for entry in data["alignments"]),
            noise=noise_from(data["noise"]),
            noise_fit=noise_fit_from(data.get("noise_fit")),
            calibration=tuple(result_from(CalibrationResult, entry) for entry in data["calibration"]),
            choices=tuple(result_from(CalibrationChoice, entry) for entry in data.get("choices", ())),
            robot_numbers=tuple(result_from(RobotNumber, entry) for entry in data.get("robot_numbers", ())),
            measurements=tuple(result_from(MeasurementResult, entry) for entry in data["measurements"]),
            checks=tuple(result_from(ConsistencyCheck, entry) for entry in data["checks"]),
            scale_budgets=tuple(result_from(ScaleBudget, entry) for entry in data["metres"]),
            warnings=tuple(data["warnings"]),
            losses=tuple(data.get("losses", ())),
            outliers=tuple(result_from(OutlierTag, entry) for entry in data["suspect_tags"]),
            advice=tuple(advice_from(entry) for entry in data.get("advice", ())),
            archived_segments=kept,
        )
    except OSError as error:
        raise OfflineError(f"{error.filename}: cannot be read ({error.strerror}); make the map again") from error
    except _DAMAGE_ERRORS as error:
        raise OfflineError(
            f"{folder}: the map's files are damaged or incomplete ({error}); make the map again"
        ) from error


def _arrays(result: MapResult) -> dict[str, Any]:
    """Return arrays in full precision and joint covariances, as needed to localise in, extend or judge the map."""
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
            f"{key}sigma_factor": np.float64(component.sigma_factor),
        }
        if component.edges is not None:
            arrays |= {f"{key}edges_{name}": value for name, value in vars(component.edges).items()}
        if component.calibration is not None:
            arrays |= arrays_of(component.calibration, f"{key}calibration_")
    for index, kept in enumerate(result.archived_segments):
        arrays |= arrays_of(kept, f"run{index}_")
    return arrays


def _read_json(folder: Path) -> dict[str, Any]:
    path = folder / JSON_FILE
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        found = (_other_kind(folder) if is_missing else "") or f"{path}: cannot be read ({error.strerror})"
        raise OfflineError(f"{found}; give the folder that `map -o` wrote") from error
    except (ValueError, RecursionError) as error:
        raise OfflineError(f"{path}: is not JSON ({error}); make the map again") from error
    if not isinstance(data, dict):
        raise OfflineError(f"{path}: holds no object; make the map again")
    return data


def _other_kind(folder: Path) -> str:
    """Return what was given instead of a map's folder; empty if that is not known."""
    if not folder.exists():
        return f"{folder}: no such folder"
    if folder.is_file():
        return f"{folder}: is a file, not the folder of a map"
    has_logs = next(folder.rglob("*.mcap*"), None) is not None
    return f"{folder}: holds logs, not a map, which `map` makes of them" if has_logs else ""


def _component(data: dict[str, Any], index: int, arrays: Mapping[str, Any], folder: Path) -> Component:
    entry, key = data["components"][index], f"component{index}_"
    starts, positions = arrays[f"{key}T_map_start"], arrays[f"{key}tag_positions_m"]
    run_entries = [each for each in data["runs"] if each["component"] == index]
    tag_entries = [each for each in data["tags"] if each["component"] == index]
    runs = tuple(_run(each, start, folder) for each, start in zip(run_entries, starts, strict=True))
    tags = tuple(tag_from(each, place) for each, place in zip(tag_entries, positions, strict=True))
    joint = arrays[f"{key}joint_covariance"]
    if joint.shape != (3 * len(runs) + 2 * len(tags),) * 2:
        raise ValueError(f"{key}joint_covariance has the shape {joint.shape}")
    names = {run.name for run in runs}
    datum = datum_from(entry.get("datum"), positions)
    if entry["frame_run"] not in (names if datum is None else (None,)):
        raise ValueError(f"component {index}: frame_run {entry['frame_run']!r} is none of its runs")
    return Component(
        frame_run=entry["frame_run"],
        runs=runs,
        tags=tags,
        joint_covariance=joint,
        cost=number_from(entry["cost"]),
        n_residuals=entry["n_residuals"],
        start_to_start=tuple(
            StartToStart(pair["a"], pair["b"], array_from(pair["vector_m"]), array_from(pair["covariance"]))
            for pair in data["start_to_start"]
            if pair["a"] in names
        ),
        edges=_edges(f"{key}edges_", arrays),
        model=MapModel(entry.get("model", MapModel.FLOOR)),
        calibration=calibration_from(arrays, f"{key}calibration_"),
        floor=floor_from(entry.get("floor")),
        sigma_factor=float(arrays[f"{key}sigma_factor"]) if f"{key}sigma_factor" in arrays else 1.0,
        misfit=misfit_from(entry.get("misfit")),
        datum=datum,
        converged=bool(entry.get("converged", True)),
    )


def _archived_segments(arrays: Mapping[str, Any]) -> tuple[ArchivedSegment, ...]:
    """Return all archived segments; none in a map of an older program."""
    found: list[ArchivedSegment] = []
    while (kept := segment_from(arrays, f"run{len(found)}_")) is not None:
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
        log=log_path(entry["log"]),
        robot_id=entry["robot"],
        run_id=entry["run_id"],
        T_map_start=T_map_start,
        covariance=array_from(entry["covariance"]),
        stamps_ns=stamps_ns,
        T_map_base=T_map_base,
        distance_m=number_from(entry["distance_m"]),
        T_base_camera=None if entry["T_base_camera"] is None else array_from(entry["T_base_camera"]),
        T_base_cameras={name: array_from(value) for name, value in entry.get("T_base_cameras", {}).items()},
    )
