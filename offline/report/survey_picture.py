"""Map and survey over each other from above, to scale: which tags are not where the survey has them."""

import os
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation import ComponentSurvey, EntryResult, SurveyErrors
from groundsbot.offline.maps import MapResult
from groundsbot.offline.report.picture import (
    MOST_PANELS,
    draw_component,
    draw_legend,
    ellipse_factor,
    legend_handles,
    make_panels,
    points_of,
    save_figure,
    tag_names,
    trails_of,
    write_labels,
)
from groundsbot.offline.report.run_styles import run_styles

_FITS: Final = "#222222"
_ODD: Final = "#C00000"
_NOT_IN_MAP: Final = "#8A8A8A"
_LINE_POINTS: Final = 20  # enough to keep labels off the lines


def write_survey_picture(result: MapResult, errors: SurveyErrors, path: Path) -> None:
    """Draw a map with a survey over it as PNG, 1600 px wide, in the frame of the map.

    Raises:
        OfflineError: the file exists, or cannot be written.
    """
    if os.path.lexists(path):
        raise OfflineError(f"--picture {path}: exists already and is not overwritten; give another file")
    try:
        save_figure(draw_survey(result, errors), path)
    except OSError as error:
        raise OfflineError(f"--picture {path}: cannot be written ({error.strerror}); choose another place") from error


def draw_survey(result: MapResult, errors: SurveyErrors) -> Figure:
    """Return the picture as a matplotlib figure, a panel for each component that was compared."""
    drawn = errors.components[:MOST_PANELS]
    placed = [_place_survey(each, errors) for each in drawn]
    figure, panels = make_panels(
        [np.concatenate([points_of(each.component), places]) for each, places in zip(drawn, placed, strict=True)]
    )
    entries = [entry for each in errors.components for entry in each.entries]
    n_odd = sum(len(each.outliers) for each in errors.components)
    figure.suptitle(
        f"Map and survey: {plural(len(entries), 'surveyed tag')} in the map, {len(entries) - n_odd} where the survey "
        f"has them, {n_odd} not; {len(errors.not_in_map)} not in the map",
        fontsize=14,
    )
    styles = run_styles(run.run for run in result.runs)
    factor = ellipse_factor([each.component for each in drawn])
    for axes, each, places in zip(panels, drawn, placed, strict=True):
        axes.set_title(f"frame: {each.component.frame_name.removeprefix('the ')}")
        draw_component(axes, each.component, styles, factor)
        _draw_entries(axes, each, places)
    draw_legend(figure, [*legend_handles(result, styles, factor), *_survey_handles()])
    for axes, each, places in zip(panels, drawn, placed, strict=True):
        _write_labels(axes, each, errors, places)
    return figure


def _place_survey(compared: ComponentSurvey, errors: SurveyErrors) -> FloatArray:
    """Return positions (N, 2) in the map of a component's entries, then of those that are not in the map."""
    entries = [each.entry for each in compared.entries] + list(errors.not_in_map)
    return se2.apply(compared.T_map_survey, np.array([entry.position_m for entry in entries]))


def _draw_entries(axes: Axes, compared: ComponentSurvey, places_m: FloatArray) -> None:
    for each, place_m in zip(compared.entries, places_m, strict=False):
        colour = _colour(each)
        axes.add_line(_circle(colour, *place_m[:, np.newaxis]))
        if each.verdict != "fits":
            x_m, y_m = np.column_stack([place_m, each.tag.position_m])
            axes.plot(x_m, y_m, color=colour, linewidth=1.4, zorder=5)
            axes.plot(x_m[1:], y_m[1:], color=colour, marker="s", markersize=6.0, zorder=5, linestyle="")
    if len(places_m) > len(compared.entries):
        axes.add_line(_circle(_NOT_IN_MAP, *places_m[len(compared.entries) :].T))


def _circle(colour: str, x_m: FloatArray, y_m: FloatArray, label: str = "") -> Line2D:
    circles = Line2D(x_m, y_m, color=colour, marker="o", markersize=10.0, linestyle="", zorder=5, label=label)
    circles.set_markerfacecolor("none")
    circles.set_markeredgewidth(1.2)
    return circles


def _colour(each: EntryResult) -> str:
    return _FITS if each.verdict == "fits" else _ODD


def _survey_handles() -> list[Line2D]:
    nowhere: FloatArray = np.zeros(0)
    odd = Line2D([], [], color=_ODD, marker="s", markersize=6.0, label="tag that is not there: by how much, and sigmas")
    return [
        _circle(_FITS, nowhere, nowhere, "place by the survey"),
        odd,
        _circle(_NOT_IN_MAP, nowhere, nowhere, "place of a tag that is not in the map"),
    ]


def _write_labels(axes: Axes, compared: ComponentSurvey, errors: SurveyErrors, places_m: FloatArray) -> None:
    """Write what each tag is called, and of those that do not fit how far they are off."""
    component = compared.component
    results = {id(each.tag): each for each in compared.entries}
    places, texts, colours = [], [], []
    for tag, name in zip(component.tags, tag_names(component), strict=True):
        each = results.get(id(tag))
        places.append(tag.position_m)
        texts.append(name if each is None else _label(each, name))
        colours.append(_FITS if each is None else _colour(each))
    for entry, place_m in zip(errors.not_in_map, places_m[len(compared.entries) :], strict=True):
        places.append(place_m)
        texts.append(f"{entry.tag_id}{entry.instance}")
        colours.append(_NOT_IN_MAP)
    lines = [
        np.linspace(place_m, each.tag.position_m, _LINE_POINTS)
        for each, place_m in zip(compared.entries, places_m, strict=False)
        if each.verdict != "fits"
    ]
    write_labels(axes, places, texts, colours, np.concatenate([trails_of(component), *lines]))


def _label(each: EntryResult, name: str) -> str:
    if each.verdict == "fits":
        return name
    off = f"{float(np.linalg.norm(each.shift_m)):.2f} m, {each.sigmas:.0f} sigmas"
    return f"{name}: {off}" if each.swapped_with is None else f"{name}: swapped with {each.swapped_with}? {off}"
