"""map.png: trajectories and tags from above, to scale."""

from collections import Counter
from collections.abc import Sequence
from math import ceil, degrees
from pathlib import Path
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Ellipse
from matplotlib.path import Path as PolygonPath
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D

from groundsbot.calib.foundation import FloatArray, atomic_write, plural
from groundsbot.offline.maps import (
    SIGMAS_95,
    Component,
    MapResult,
    RunResult,
    TagResult,
    drawn_covariances,
    largest_sigmas_m,
    shape_of,
)
from groundsbot.offline.report.label_places import place_labels
from groundsbot.offline.report.run_styles import N_STYLES, RunStyle, run_styles

_SHARED: Final = "#222222"
_DPI: Final = 100
_WIDTH_IN: Final = 16.0
_HEIGHT_LIMITS_IN: Final = (7.0, 16.0)
_DECORATION_IN: Final = 1.6  # title, axis labels and legend
_MARGIN: Final = 0.04  # relative to the extent, so that ids near the rim fit in
MOST_PANELS: Final = 6
_VISIBLE_SHARE: Final = 0.006  # of the extent: ellipses are enlarged if a typical half axis is smaller
_FACTORS: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_TRAIL_POINTS: Final = 2000  # enough to keep ids off the trajectories
_LABEL_PT: Final = 9.0
_MOST_COVERED: Final = 0.3  # of a panel by labels; of thousands of tags they would hide all else
_START_SIZE: Final = 17.0
_ARROWHEAD: Final = PolygonPath([(1.0, 0.0), (-0.8, 0.65), (-0.4, 0.0), (-0.8, -0.65), (1.0, 0.0)], closed=True)


def write_picture(result: MapResult, path: Path) -> None:
    """Draw a map as PNG, 1600 px wide: one panel per component, in metres, the same scale along both axes."""
    save_figure(draw_map(result), path)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    with atomic_write(path) as partial, partial.open("wb") as stream:
        figure.savefig(stream, format="png", dpi=_DPI, metadata={"Software": "groundsbot"})


def draw_map(result: MapResult) -> Figure:
    """Return the picture as a matplotlib figure."""
    components = result.components[:MOST_PANELS]
    figure, panels = make_panels([points_of(component) for component in components])
    figure.suptitle(_title(result), fontsize=14)
    styles = run_styles(run.run for run in result.runs)
    factor = ellipse_factor(components)
    for index, (axes, component) in enumerate(zip(panels, components, strict=True)):
        if len(result.components) > 1:
            seen = f"{'from' if component.datum is None else 'in'} {component.frame_name}"
            axes.set_title(f"component {index + 1}: {plural(len(component.tags), 'tag')}, {seen}")
        draw_component(axes, component, styles, factor)
    draw_legend(figure, legend_handles(result, styles, factor))
    for axes, component in zip(panels, components, strict=True):
        _write_ids(axes, component, styles)
    return figure


def make_panels(points_m: Sequence[FloatArray]) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel to scale for each set of points (N, 2), all of which fit in."""
    columns = 1 if len(points_m) == 1 else 2
    rows = ceil(len(points_m) / columns)
    figure = Figure(figsize=(_WIDTH_IN, _height_in(points_m, columns, rows)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = []
    for index, points in enumerate(points_m):
        axes = figure.add_subplot(rows, columns, index + 1)
        low, high = points.min(axis=0), points.max(axis=0)
        margin = max(_MARGIN * float((high - low).max()), 0.5)
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - margin, high[1] + margin)
        axes.set_aspect("equal")
        axes.set_xlabel("x in m")
        axes.set_ylabel("y in m")
        axes.grid(color="#e4e4e4", linewidth=0.6)
        axes.set_axisbelow(True)
        panels.append(axes)
    return figure, panels


def _height_in(points_m: Sequence[FloatArray], columns: int, rows: int) -> float:
    """Return the height at which the widest panel fills its column."""
    panel_in = (_WIDTH_IN - 1.0) / columns
    ratio = max((high / wide for wide, high in map(_extent_m, points_m)), default=0.5)
    return float(np.clip(rows * (panel_in * ratio + 0.6) + _DECORATION_IN, *_HEIGHT_LIMITS_IN))


def points_of(component: Component) -> FloatArray:
    """Return the positions (N, 2) of a component's trajectories and tags."""
    parts = [run.T_map_base[:, :2] for run in component.runs]
    parts += [tag.position_m[np.newaxis, :2] for tag in component.tags]
    return np.concatenate(parts)


def _extent_m(points_m: FloatArray) -> tuple[float, float]:
    """Return width and height, at least a metre, since a robot may never have moved."""
    wide, high = np.maximum(np.ptp(points_m, axis=0), 1.0)
    return float(wide), float(high)


def _title(result: MapResult) -> str:
    runs = {run.run for run in result.runs}
    n_tags = sum(len(component.tags) for component in result.components)
    driven_m = sum(run.distance_m for run in result.runs)
    title = f"{plural(n_tags, 'tag')}, {plural(len(runs), 'run')}, {driven_m:.0f} m driven"
    pairs = [pair for component in result.components for pair in component.start_to_start]
    if len(pairs) == 1:
        title += f", start to start {pairs[0].distance_m:.2f} m (sigma {pairs[0].sigma_m:.2f} m)"
    if len(result.components) > 1:
        title += f", in {len(result.components)} components"
    if len(result.components) > MOST_PANELS:
        title += f", the {MOST_PANELS} largest drawn"
    return title


def ellipse_factor(components: Sequence[Component]) -> int:
    """Return the factor by which ellipses are enlarged so that a typical one is visible."""
    covariances = np.concatenate([drawn_covariances(component) for component in components])
    half_axes = SIGMAS_95 * largest_sigmas_m(covariances)
    half_axes = half_axes[np.isfinite(half_axes)]
    extent_m = max((max(_extent_m(points_of(component))) for component in components), default=1.0)
    typical_m = float(np.median(half_axes)) if len(half_axes) else extent_m
    wanted = _VISIBLE_SHARE * extent_m / max(typical_m, 1e-12)
    return next((factor for factor in _FACTORS if factor >= wanted), _FACTORS[-1])


def draw_component(axes: Axes, component: Component, styles: dict[str, RunStyle], factor: int) -> None:
    """Draw trajectories, starts and tags."""
    for run in component.runs:
        line = _line(run.T_map_base[:, 0], run.T_map_base[:, 1], styles[run.run])
        axes.add_line(line).set_zorder(3)
        _draw_start(axes, run, styles[run.run].colour)
    _draw_tags(axes, component, styles, factor)


def _line(x_m: FloatArray, y_m: FloatArray, style: RunStyle, label: str = "") -> Line2D:
    line = Line2D(x_m, y_m, color=style.colour, linewidth=1.4, label=label)
    line.set_linestyle((0, style.dashes) if style.dashes else "-")
    return line


def _draw_start(axes: Axes, run: RunResult, colour: str) -> None:
    """Draw an arrowhead in the direction of the start; an equilateral triangle would not show it."""
    x_m, y_m, theta_rad = run.T_map_start
    marker = MarkerStyle(_ARROWHEAD, transform=Affine2D().rotate(theta_rad))
    (start,) = axes.plot([x_m], [y_m], marker=marker, color=colour, markersize=_START_SIZE, zorder=6, linestyle="")
    start.set_markeredgecolor("white")
    start.set_markeredgewidth(1.2)


def _draw_tags(axes: Axes, component: Component, styles: dict[str, RunStyle], factor: int) -> None:
    places_m: dict[str, list[FloatArray]] = {}
    for tag, covariance in zip(component.tags, drawn_covariances(component), strict=True):
        colour = _tag_colour(tag, component, styles)
        places_m.setdefault(colour, []).append(tag.position_m[:2])
        if np.isfinite(covariance).all():
            axes.add_artist(_ellipse(tag, covariance, colour, factor))  # add_patch would update the limits each time
    for colour, places in places_m.items():
        axes.plot(*np.array(places).T, marker="s", color=colour, markersize=4.0, zorder=4, linestyle="")


def _ellipse(tag: TagResult, covariance: FloatArray, colour: str, factor: int) -> Ellipse:
    variances, directions = np.linalg.eigh(covariance)
    small_m, large_m = SIGMAS_95 * np.sqrt(np.maximum(variances, 0.0)) * factor
    angle_deg = degrees(np.arctan2(directions[1, 1], directions[0, 1]))
    ellipse = Ellipse(
        (tag.position_m[0], tag.position_m[1]), 2 * large_m, 2 * small_m, angle=angle_deg, linewidth=0.8, zorder=2
    )
    ellipse.set(facecolor=(colour, 0.15), edgecolor=(colour, 0.7))
    return ellipse


def _tag_colour(tag: TagResult, component: Component, styles: dict[str, RunStyle]) -> str:
    """Return the colour of its run, or dark if several runs observed it: those tags connect the runs."""
    run_of = {run.name: run.run for run in component.runs}
    seen_by = {run_of.get(name, name) for name in tag.runs}
    if len(seen_by) != 1:
        return _SHARED
    return styles.get(seen_by.pop(), RunStyle(_SHARED, ())).colour


def draw_legend(figure: Figure, handles: Sequence[Line2D]) -> None:
    """Draw the legend and fix the layout, so that labels can be placed in pixels."""
    # Handles are as long as the longest dashes and their repetition.
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(3, len(handles)),
        fontsize=10,
        frameon=False,
        handlelength=4,
    )
    for _ in range(2):
        figure.draw_without_rendering()
    figure.set_layout_engine(None)  # saving would compute it, and draw, twice more


def legend_handles(result: MapResult, styles: dict[str, RunStyle], factor: int) -> list[Line2D]:
    """Return what runs and markers of a map mean."""
    handles = []
    nowhere: FloatArray = np.zeros(0)
    run_of = {part.name: part.run for part in result.runs}
    n_tags_of = Counter(run for tag in result.tags for run in {run_of.get(name, name) for name in tag.runs})
    if len(styles) > N_STYLES:
        label = f"{len(styles)} runs, more than there are colours: see report.html"
        handles.append(_line(nowhere, nowhere, next(iter(styles.values())), label))
        styles = {}
    for run, style in styles.items():
        parts = [part for part in result.runs if part.run == run]
        segments = f", {len(parts)} segments" if len(parts) > 1 else ""
        label = f"{run}: {sum(p.distance_m for p in parts):.1f} m, {plural(n_tags_of[run], 'tag')}{segments}"
        handles.append(_line(nowhere, nowhere, style, label))
    handles.append(_marker_handle(_ARROWHEAD, 11.0, "#777777", "start of a run, pointing ahead"))
    handles.append(_marker_handle("s", 4.0, "#777777", "tag observed by one run (its colour)"))
    if any(len(tag.runs) > 1 for component in result.components for tag in component.tags):
        handles.append(_marker_handle("s", 4.0, _SHARED, "tag observed by several runs"))
    if any(component.tags for component in result.components):
        handles.append(_ellipse_handle(result.components, factor))
    return handles


def _ellipse_handle(components: Sequence[Component], factor: int) -> Line2D:
    """Return what ellipses mean: how likely they hold a tag, and what they are relative to."""
    is_shape = any(shape_of(component) is not None for component in components)
    label = f"95 % ellipse, relative to {'the other tags' if is_shape else components[0].frame_name}"
    label += "" if factor == 1 else f", drawn {factor} times its size"
    handle = _marker_handle("o", 9.0, "#777777", label)
    handle.set_markerfacecolor(("#777777", 0.15))
    return handle


def _marker_handle(marker: Literal["s", "o"] | PolygonPath, size: float, colour: str, label: str) -> Line2D:
    return Line2D([], [], color=colour, marker=marker, markersize=size, linestyle="", label=label)


def _write_ids(axes: Axes, component: Component, styles: dict[str, RunStyle]) -> None:
    """Write every tag's id beside it."""
    colours = [_tag_colour(tag, component, styles) for tag in component.tags]
    places = [tag.position_m for tag in component.tags]
    write_labels(axes, places, tag_names(component), colours, trails_of(component))


def trails_of(component: Component) -> FloatArray:
    """Return positions (N, 2) on a component's trajectories, enough to keep labels off them."""
    trails = np.concatenate([run.T_map_base[:, :2] for run in component.runs])
    return trails[:: ceil(len(trails) / _TRAIL_POINTS)]


def tag_names(component: Component) -> list[str]:
    """Return each tag's id, with its family where there are several."""
    families = {tag.family for tag in component.tags}
    return [tag.label if len(families) == 1 else tag.full_label for tag in component.tags]


def write_labels(
    axes: Axes, places_m: Sequence[FloatArray], texts: Sequence[str], colours: Sequence[str], trails_m: FloatArray
) -> None:
    """Write a text beside each place, where it covers no other place, text or trail if there is such a position.

    Nothing is written where texts would cover much of the panel.
    """
    if not texts:
        return
    px_per_pt = axes.figure.dpi / 72.0
    places_px = axes.transData.transform(np.array(places_m))
    trails_px = axes.transData.transform(trails_m)
    sizes_px = np.array([[0.64 * len(text) * _LABEL_PT, 1.1 * _LABEL_PT] for text in texts]) * px_per_pt
    if sizes_px.prod(axis=1).sum() > _MOST_COVERED * axes.bbox.width * axes.bbox.height:
        return
    centres = axes.transData.inverted().transform(place_labels(places_px, sizes_px, trails_px, axes.bbox.get_points()))
    for text, colour, (x_m, y_m) in zip(texts, colours, centres, strict=True):
        label = axes.text(x_m, y_m, text, fontsize=_LABEL_PT, ha="center", va="center", zorder=7)
        label.set_color(colour)
        label.set_path_effects([withStroke(linewidth=2.0, foreground="white")])
