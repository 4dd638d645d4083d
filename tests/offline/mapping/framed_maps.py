"""Drives whose maps are put into a frame, and a survey of their tags."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.mapping.frame import FrameChoice
from groundsbot.offline.maps.datum import DatumKind, TagDatum
from groundsbot.offline.maps.frame import CrossCovariances, move_to_tags, tags_own_axes
from groundsbot.offline.maps.result import Component, MapResult
from groundsbot.offline.measurements.run import Run
from tests.offline.localization.test_localization import PLACES
from tests.offline.localization.test_localization import run_of as make_run_past

TAGS = {"a": (1, 2, 3, 4), "b": (3, 4, 5, 6, 1), "c": (1, 2, 3, 4, 5, 6)}
NOISE = NoiseParameters()
OWN_AXES = FrameChoice(DatumKind.TAGS)
T_SURVEY_WORLD = np.array([100.0, -7.0, 1.2])


def run_of(name: str, tags: tuple[int, ...] | None = None) -> Run:
    """A drive past its tags, or some others."""
    return make_run_past(name, TAGS[name] if tags is None else tags)


def write_survey(path: Path, tags: Sequence[int], errors_m: dict[int, tuple[float, float]] | None = None) -> str:
    """A survey of some tags, exact but for errors; returns the option's value."""
    rows = ["tag_id,x_m,y_m,sigma_m"]
    for tag in tags:
        x_m, y_m = se2.apply(T_SURVEY_WORLD, PLACES[tag]) + (errors_m or {}).get(tag, (0.0, 0.0))
        rows.append(f"{tag},{x_m:.6f},{y_m:.6f},{0.005 * tag:.3f}")
    path.write_text("\n".join(rows) + "\n")
    return f"survey:{path}"


def in_own_axes(result: MapResult) -> MapResult:
    """The map in its tags' own axes."""
    moved = []
    for component in result.components:
        n = 0 if component.calibration is None else len(component.calibration.values)
        cross = CrossCovariances(np.zeros((n, 3 * len(component.runs))), None)  # counts in the frame of a start only
        datum = TagDatum(DatumKind.TAGS, np.ones(len(component.tags)))
        moved.append(move_to_tags(component, datum, tags_own_axes(component), cross))
    return replace(result, components=tuple(moved))


def places_of(component: Component) -> FloatArray:
    return np.array([tag.position_m for tag in component.tags])
