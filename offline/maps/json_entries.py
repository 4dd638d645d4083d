"""Entries of map.json read back as typed results: every field is checked; null is NaN where a number is required."""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from functools import cache
from typing import Annotated, Any, Final, TypeVar, cast, get_type_hints

import numpy as np
from pydantic import BaseModel, BeforeValidator, create_model

from groundsbot.calib.foundation import FloatArray, validate
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.maps.datum import DatumKind, SurveyedTag, TagDatum, datum_centre
from groundsbot.offline.maps.fit_results import AlignmentResult, AlternativeResult, Misfit
from groundsbot.offline.maps.parameter_results import FittedNoise
from groundsbot.offline.maps.result import AdviceResult, FloorSigmas, TagPose, TagResult

Result = TypeVar("Result")


def array_from(values: Sequence[Any]) -> FloatArray:
    """Return an array from nested lists of numbers and nulls."""
    return np.array(values, dtype=np.float64)


def number_from(value: float | None) -> float:
    """Return a number, NaN for null."""
    return float("nan") if value is None else value


_JSON_TYPES: Final[dict[Any, Any]] = {
    float: Annotated[float, BeforeValidator(number_from)],
    FloatArray: Annotated[Any, BeforeValidator(array_from)],
    FloatArray | None: Annotated[Any, BeforeValidator(lambda values: None if values is None else array_from(values))],
}


def result_from(kind: type[Result], entry: Mapping[str, Any], **built: object) -> Result:
    """Return a result of a dataclass from an entry with its fields' names; further keys are ignored.

    Args:
        kind: the dataclass.
        entry: entry of map.json.
        built: fields that are not taken from the entry.

    Raises:
        CalibError: a field is missing or of another type.
    """
    model = validate(_entry_model(cast(Any, kind), frozenset(built)), entry, f"an entry of {kind.__name__}")
    return kind(**vars(model) | built)


@cache
def _entry_model(kind: Any, built: frozenset[str]) -> type[BaseModel]:  # noqa: ANN401 - a dataclass, as a key
    hints = get_type_hints(kind)
    definitions: dict[str, Any] = {}
    for each in fields(kind):
        if each.name not in built:
            default = ... if each.default is MISSING else each.default
            definitions[each.name] = (_JSON_TYPES.get(hints[each.name], hints[each.name]), default)
    return create_model(kind.__name__, **definitions)


def noise_from(entry: dict[str, Any]) -> NoiseParameters:
    """Return the noise parameters of `noise`, without those of the floor, which belong to components."""
    floor = {each.name for each in fields(FloorSigmas)}
    return validate(NoiseParameters, {name: value for name, value in entry.items() if name not in floor}, "noise")


def floor_from(entry: dict[str, Any] | None) -> FloorSigmas | None:
    """Return `floor` of a component."""
    return None if entry is None else result_from(FloorSigmas, entry)


def misfit_from(entry: dict[str, Any] | None) -> Misfit | None:
    """Return `misfit` of a component; maps of older programs have none."""
    return None if entry is None else result_from(Misfit, entry)


def noise_fit_from(entry: dict[str, Any] | None) -> FittedNoise | None:
    """Return `noise_fit`."""
    return None if entry is None else result_from(FittedNoise, entry)


def datum_from(entry: dict[str, Any] | None, places_m: FloatArray) -> TagDatum | None:
    """Return `datum` of a component with tags at positions (T, 2); None where a run's start is the frame."""
    if entry is None:
        return None
    weights = array_from(entry["weights"])
    if weights.shape != places_m.shape[:1] or not ((weights >= 0.0) & (weights < np.inf)).all():
        raise ValueError(f"datum.weights are not {len(places_m)} finite numbers from 0 on")
    if datum_centre(places_m, weights) is None:
        raise ValueError("datum.weights: these tags determine no frame")
    survey = tuple(_surveyed_tag(each, len(places_m)) for each in entry.get("survey", ()))
    return TagDatum(DatumKind(entry["kind"]), weights, survey)


def _surveyed_tag(entry: dict[str, Any], n_tags: int) -> SurveyedTag:
    found = result_from(SurveyedTag, entry, position_m=array_from(entry["position_m"]))
    if found.position_m.shape != (2,) or not np.isfinite(found.position_m).all():
        raise ValueError(f"datum.survey: the position of tag {found.tag_id} is not two finite numbers")
    if found.tag is not None and not 0 <= found.tag < n_tags:
        raise ValueError(f"datum.survey: {found.tag} is the index of none of {n_tags} tags")
    return found


def tag_from(entry: dict[str, Any], position_m: FloatArray) -> TagResult:
    """Return an entry of `tags`, with its position (2,) in full precision."""
    covariance = array_from(entry["covariance"])[:2, :2]
    return result_from(TagResult, entry, position_m=position_m, covariance=covariance, pose=_tag_pose(entry))


def _tag_pose(entry: dict[str, Any]) -> TagPose | None:
    if entry["quaternion_xyzw"] is None:
        return None
    height_m = number_from(entry["position_m"][2])
    return TagPose(height_m, array_from(entry["quaternion_xyzw"]), array_from(entry["pose_covariance"]))


def alignment_from(entry: dict[str, Any]) -> AlignmentResult:
    """Return an entry of `alignments`."""
    renamed = {"from_run": "from", "to_run": "to", "T_from_to": "transform", "is_accepted": "is_sure"}
    alternatives = tuple(
        AlternativeResult(array_from(each["transform"]), _tag_names(each["tags"])) for each in entry["rivals"]
    )
    named = {name: entry[key] for name, key in renamed.items()} | {"outliers": _tag_names(entry["outliers"])}
    return result_from(AlignmentResult, entry | named, alternatives=alternatives)


def advice_from(entry: dict[str, Any]) -> AdviceResult:
    """Return an entry of `advice`."""
    tags = [(each["family"], each["tag_id"], each["instance"]) for each in (*entry["tags"], entry["worst_tag"])]
    way_m = array_from(entry["way_m"]).reshape(-1, 2)
    return result_from(AdviceResult, entry | {"tags": tags[:-1], "worst_tag": tags[-1]}, way_m=way_m)


def _tag_names(entries: Sequence[dict[str, Any]]) -> tuple[tuple[str, int], ...]:
    return tuple((entry["family"], entry["tag_id"]) for entry in entries)
