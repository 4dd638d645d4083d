"""Surveys as files: a CSV of measured positions, or a field layout of WPILib (AprilTagFieldLayout or Field)."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, StrPath
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import CsvTable, read_table

# Accuracy of a tape measure and a plumb line, if the file has no sigma; layouts have none.
DEFAULT_SIGMA_M: Final = 0.02
_MAX_PLACE_M: Final = 1e8  # no place on the earth is farther from the origin of any grid
_MAX_SIGMA_M: Final = 1000.0  # beyond the range of any observation
_LAYOUT_KEYS: Final = ("tags", "field-tags")  # of AprilTagFieldLayout, and of Field


@dataclass(frozen=True)
class SurveyEntry:
    """One measured position, in the survey's own frame."""

    family: str  # empty: not given
    tag_id: int
    instance: str
    position_m: FloatArray  # (2,)
    sigma_m: float  # of each coordinate
    is_sigma_assumed: bool = False  # the file gives none


def read_survey(path: StrPath) -> list[SurveyEntry]:
    """Read `tag_id,x_m,y_m` and, if present, `sigma_m,family,instance`; or, from a .json, WPILib's layout.

    Raises:
        OfflineError: not such a file, or a tag twice in it.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        return _read_layout(path)
    table = read_table(path)
    missing = [column for column in ("tag_id", "x_m", "y_m") if column not in table]
    if missing:
        raise OfflineError(f"{path}: has no column {', '.join(missing)}; a survey has tag_id,x_m,y_m and maybe sigma_m")
    n = len(table)
    ids = table.integers("tag_id", minimum=0)
    x_m, y_m = (table.numbers_below(column, _MAX_PLACE_M) for column in ("x_m", "y_m"))
    has_sigmas = "sigma_m" in table
    sigmas = table.positive_numbers("sigma_m", _MAX_SIGMA_M) if has_sigmas else [DEFAULT_SIGMA_M] * n
    families = table.text("family") if "family" in table else [""] * n
    instances = table.text("instance") if "instance" in table else [""] * n
    entries = [
        SurveyEntry(family, tag_id, instance, np.array([x, y]), sigma, is_sigma_assumed=not has_sigmas)
        for family, tag_id, instance, x, y, sigma in zip(families, ids, instances, x_m, y_m, sigmas, strict=True)
    ]
    _check_no_duplicates(table, entries)
    return entries


def _check_no_duplicates(table: CsvTable, entries: Sequence[SurveyEntry]) -> None:
    seen = set()
    for row, entry in enumerate(entries):
        name = (entry.family, entry.tag_id, entry.instance)
        if name in seen:
            table.fail(row, "tag_id", "is there twice; leave one row out, or give each its instance")
        seen.add(name)


def _read_layout(path: Path) -> list[SurveyEntry]:
    """Read the positions of a layout's tags, whose family it does not say.

    Raises:
        OfflineError: not such a file, or a tag twice in it.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OfflineError(f"{path}: cannot be read ({error.strerror}); give a CSV file or WPILib's layout") from error
    except (ValueError, RecursionError) as error:
        raise OfflineError(f"{path}: is not JSON ({error}); give WPILib's layout of the field") from error
    key = next((each for each in _LAYOUT_KEYS if isinstance(data, dict) and isinstance(data.get(each), list)), None)
    if key is None:
        raise OfflineError(
            f"{path}: has no list {' or '.join(map(repr, _LAYOUT_KEYS))}; give WPILib's layout of a field"
        )
    entries = [_layout_entry(f"{path}: {key}[{i}]", tag) for i, tag in enumerate(data[key])]
    twice = [tag_id for tag_id, n in Counter(entry.tag_id for entry in entries).items() if n > 1]
    if twice:
        raise OfflineError(f"{path}: tag {twice[0]} is there twice; leave one out")
    return entries


def _layout_entry(where: str, tag: Any) -> SurveyEntry:  # noqa: ANN401 - whatever the file holds
    try:
        tag_id, place = tag["ID"], tag["pose"]["translation"]
        x_m, y_m = place["x"], place["y"]
    except (KeyError, TypeError) as error:
        raise OfflineError(f"{where}: has no ID and pose.translation with x and y; correct it") from error
    if not isinstance(tag_id, int) or tag_id < 0:
        raise OfflineError(f"{where}: ID is {tag_id!r}, must be a whole number from 0 on; correct it")
    for name, value in (("x", x_m), ("y", y_m)):
        if not isinstance(value, int | float) or not math.isfinite(value) or abs(value) > _MAX_PLACE_M:
            raise OfflineError(f"{where}: {name} is {value!r}, must be a number of metres; correct it")
    position_m = np.array([x_m, y_m], dtype=np.float64)
    return SurveyEntry("", tag_id, "", position_m, DEFAULT_SIGMA_M, is_sigma_assumed=True)
