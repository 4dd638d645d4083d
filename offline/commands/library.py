"""What the commands `compare` and `export` do with a finished map, as functions."""

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from os import fspath
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from groundsbot.calib.foundation import StrPath
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation import (
    MapErrors,
    SurveyErrors,
    evaluate,
    evaluate_survey,
    read_survey,
    read_truth,
)
from groundsbot.offline.export import ExportFormat, ExportOptions, LayoutForm
from groundsbot.offline.export import export_map as export_folder
from groundsbot.offline.maps import MapResult, read_map, write_map

_Choice = TypeVar("_Choice", bound=StrEnum)


def compare_map(
    result: MapResult | StrPath, *, truth: StrPath | None = None, survey: StrPath | None = None
) -> MapErrors | SurveyErrors:
    """Return the errors of a map against the truth of a simulation or a survey; `MapErrors.lines()` has them as text.

    Args:
        result: a map, or the folder of one.
        truth: truth.json of `simulate`.
        survey: measured positions: a CSV file of tag_id,x_m,y_m, or WPILib's layout (.json). The map is aligned to it.

    Raises:
        OfflineError: not exactly one of `truth` and `survey` is given, a file cannot be used, or the map shares too
            little with it.
    """
    known = result if isinstance(result, MapResult) else read_map(result)
    if truth is not None and survey is None:
        return evaluate(known, read_truth(truth))
    if survey is not None and truth is None:
        return evaluate_survey(known, read_survey(survey))
    raise OfflineError("compare_map: compares with one thing at a time; give either truth or survey")


def export_map(
    result: MapResult | StrPath,
    form: str,
    output: StrPath,
    *,
    component: int | None = None,
    origin: str | None = None,
    tag_poses: StrPath | None = None,
    tag_height_m: float | None = None,
    face_viewers: bool = False,
    field_m: str | None = None,
    family: str | None = None,
    layout_form: str | None = None,
    frame: StrPath | None = None,
) -> list[str]:
    """Write a map in the format of another tool, as the options of `groundsbot-offline export` say.

    Args:
        result: a map, or the folder of one.
        form: g2o, tum, csv, geojson, frc or limelight.
        output: a new file; for tum and csv a new folder.
        component: index of the component, if there are several.
        origin: geojson: LAT_DEG,LON_DEG,HEADING_DEG of the map's frame.
        tag_poses: frc, limelight: copy of tags.csv with measured heights and yaws.
        tag_height_m: frc, limelight: height of tags that have none.
        face_viewers: frc, limelight: assume that tags face their observers.
        field_m: frc: LENGTH,WIDTH of the field.
        family: frc: the family to write.
        layout_form: frc: tags or field-tags.
        frame: another frame than the map's, as for `parse_frame`.

    Returns:
        What was written and what is to be known of it, a line each.

    Raises:
        GroundsbotError: the output exists, there is no such form, or the map does not hold what it needs. Nothing is
            written then.
    """
    options = ExportOptions(
        _choice(ExportFormat, "form", form),
        Path(output),
        component,
        origin,
        None if tag_poses is None else Path(tag_poses),
        tag_height_m,
        face_viewers,
        field_m,
        family,
        None if layout_form is None else _choice(LayoutForm, "layout_form", layout_form),
        None if frame is None else fspath(frame),
    )
    with _folder_of(result) as folder:
        return export_folder(folder, options)


def _choice(kind: type[_Choice], name: str, value: str) -> _Choice:
    """Return the member of an enumeration with a value."""
    try:
        return kind(value)
    except ValueError as error:
        raise OfflineError(f"{name}: {value!r} is none of {', '.join(kind)}") from error


@contextmanager
def _folder_of(result: MapResult | StrPath) -> Iterator[Path]:
    """Yield the folder of a map, a temporary one for a map in memory."""
    if not isinstance(result, MapResult):
        yield Path(result)
        return
    with TemporaryDirectory() as folder:
        write_map(result, folder)
        yield Path(folder)
