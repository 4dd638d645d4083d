"""Lines of the `map` command for the terminal: on one screen, or with all results."""

import textwrap
from collections.abc import Sequence
from math import ceil, degrees
from pathlib import Path
from typing import Final

from groundsbot.calib.foundation import plural
from groundsbot.offline.commands.shared import scale_line
from groundsbot.offline.commands.terminal import table_lines
from groundsbot.offline.foundation import StageCost
from groundsbot.offline.maps import (
    JSON_FILE,
    NOT_NEEDED,
    AlignmentResult,
    Component,
    FittedNoise,
    MapResult,
    MeasurementResult,
    map_as_json,
)
from groundsbot.offline.report import (
    advice_sentences,
    contradiction_sentence,
    headline,
    verdict_sentence,
)
from groundsbot.offline.self_calibration import refusal_lines, verdict_lines

REPORT_FILE: Final = "report.html"
OF_REPORT: Final = ("plotly", "jinja2")  # what the report needs
# A screen of 24 rows, with one for the next prompt.
_SCREEN_ROWS: Final = 23
_SCREEN_COLUMNS: Final = 100
_LEAST_DOUBT_ROWS: Final = 4  # if the rest fills the screen
_MOST_DOUBTS: Final = 5
_MOST_ENTRIES: Final = 3  # robot parameters, or components


def summary(result: MapResult, output: Path, *, verbose: bool = False) -> list[str]:
    """Return lines for the terminal: the verdict, what asks for action, the result, advice, and the files.

    Args:
        result: the map.
        output: its folder.
        verbose: all that asks for action, advice, and tables of runs, alignments, distances between starts and all
            robot parameters, noise and scale. Otherwise what fits on a screen of 24 x 100 characters: at most five
            lines that ask for action, and advice only where there are none.
    """
    document = map_as_json(result)
    verdict = [verdict_sentence(document)]
    rest = [
        headline(document),
        *_component_lines(result, verbose=verbose),
        *(_pair_lines(result) if verbose else []),
        *_measurement_lines(result),
        # The scale shows the effect of measurements.
        *(_scale_lines(result) if verbose or result.measurements else []),
        *(_noise_lines(result.noise_fit) if verbose and result.noise_fit is not None else []),
        *_floor_lines(result),
        *(verdict_lines(result.robot_numbers) if verbose else verdict_lines(result.robot_numbers, most=_MOST_ENTRIES)),
    ]
    doubts = [each for each in (contradiction_sentence(document),) if each] + _action_lines(result)
    if verbose or not doubts:
        # Components must be merged first.
        rest += [f"advice: {each}" for each in (advice_sentences(document) if len(result.components) == 1 else ())]
    rest += [f"map: {output / JSON_FILE}", f"picture: {output / 'map.png'}", _report_line(output)]
    if not verbose:
        doubts = _shorten(doubts, max(_LEAST_DOUBT_ROWS, _SCREEN_ROWS - _n_rows(verdict + rest)))
    return [*verdict, *doubts, *rest]


def _action_lines(result: MapResult) -> list[str]:
    """Return losses, outliers and warnings, the gravest first."""
    return [
        *(f"lost: {loss}" for loss in result.losses),
        *(f"suspect: {suspect.line()}" for suspect in result.outliers),
        *(f"warning: {warning}" for warning in result.warnings),
        *refusal_lines(result),
    ]


def _shorten(lines: Sequence[str], most_rows: int) -> list[str]:
    """Return the first lines, shortened, at most five and on so many rows of a screen, and the number of the others.

    A suspect's line is one row long, since the runs that observed it are in the report.
    """
    short: list[str] = []
    for line in lines[:_MOST_DOUBTS]:
        n_rows = most_rows - 1 - _n_rows(short)
        if n_rows < 1:
            break
        width = _SCREEN_COLUMNS * (1 if line.startswith("suspect: ") else n_rows)
        short.append(textwrap.shorten(line, width, placeholder=" ..."))
    rest = len(lines) - len(short)
    if rest:
        return [*short, f"{rest} more: in the report, or with -v"]
    return short if short == [*lines] else [*short, "in full: in the report, or with -v"]


def _n_rows(lines: Sequence[str]) -> int:
    """Return the number of rows on the screen, where long lines are wrapped."""
    return sum(max(1, ceil(len(line) / _SCREEN_COLUMNS)) for line in lines)


def _report_line(output: Path) -> str:
    path = output / REPORT_FILE
    without = f"report: none without {' and '.join(OF_REPORT)}; pip install 'groundsbot[laptop]'"
    return f"report: {path}" if path.is_file() else without


def stage_lines(costs: Sequence[StageCost]) -> list[str]:
    """Return a table of the cost of each stage."""
    lines = [f"{'stage':<28}{'seconds':>8}{'of CPU':>8}{'peak MiB':>10}"]
    for name, seconds, cpu_seconds, peak_mib in costs:
        peak = "" if peak_mib is None else f"{peak_mib:10.0f}"
        lines.append(f"{name:<28}{seconds:8.2f}{cpu_seconds:8.2f}{peak}")
    return lines


def _component_lines(result: MapResult, *, verbose: bool) -> list[str]:
    """Return how much is in the map and in which frame; with several components, of the first ones or all."""
    if len(result.components) == 1:
        (component,) = result.components
        frame = f"{component.frame_owner}'s start" if component.datum is None else component.frame_owner
        tags = plural(len(component.tags), "tag")
        lines = [f"{_runs_text(component)}; {tags} in one map, in the frame of {frame}"]
    else:
        lines = [
            f"component {n}, in the frame of {each.frame_owner}: {plural(len(each.tags), 'tag')}; {_runs_text(each)}"
            for n, each in enumerate(result.components, start=1)
        ]
    if verbose:
        return [*lines, *_run_table(result)]
    more = len(lines) - _MOST_ENTRIES
    return lines if more <= 0 else [*lines[:_MOST_ENTRIES], f"and {plural(more, 'more component')}"]


def _runs_text(component: Component) -> str:
    driven_m = sum(run.distance_m for run in component.runs)
    return f"{plural(len({run.run for run in component.runs}), 'run')}, {driven_m:.1f} m driven"


def _run_table(result: MapResult) -> list[str]:
    rows = [
        (
            run.name,
            f"{run.n_keyframes}",
            f"{run.distance_m:.1f}",
            f"{sum(run.name in tag.runs for tag in component.tags)}",
        )
        for component in result.components
        for run in component.runs
    ]
    return table_lines(("run", "keyframes", "driven (m)", "tags"), rows, n_text=1)


def _pair_lines(result: MapResult) -> list[str]:
    """Return tables of the alignments and of the distances between starts."""
    lines = []
    if result.alignments:
        head = ("alignment of", "with", "tags that fit", "RMS (m)", "x (m)", "y (m)", "turn (deg)", "")
        lines += table_lines(head, [_alignment_row(each) for each in result.alignments], n_text=2)
    pairs = [pair for component in result.components for pair in component.start_to_start]
    if pairs:
        rows = [(pair.a, pair.b, f"{pair.distance_m:.3f}", f"{pair.sigma_m:.3f}") for pair in pairs]
        lines += table_lines(("start of", "to start of", "distance (m)", "sigma (m)"), rows, n_text=2)
    return lines


def _alignment_row(alignment: AlignmentResult) -> tuple[str, ...]:
    x_m, y_m, theta_rad = alignment.T_from_to
    weak = "weak: rests on one tag" if alignment.is_weak else ""
    return (
        alignment.from_run,
        alignment.to_run,
        f"{alignment.n_inliers} of {alignment.n_shared}",
        f"{alignment.inlier_rmse_m:.2f}",
        f"{x_m:.2f}",
        f"{y_m:.2f}",
        f"{degrees(theta_rad):.1f}",
        weak if alignment.is_accepted else "uncertain, so not used",
    )


def _measurement_lines(result: MapResult) -> list[str]:
    """Return the external measurements that the map has values of."""
    return [
        _measurement_line(each, None if each.component is None else result.components[each.component].frame_run)
        for each in result.measurements
        if each.in_map is not None
    ]


def _scale_lines(result: MapResult) -> list[str]:
    return [scale_line(each, several=len(result.scale_budgets) > 1) for each in result.scale_budgets]


def _measurement_line(measurement: MeasurementResult, frame_run: str | None) -> str:
    """Return an external measurement, and how it agrees with the map."""
    what = f"{measurement.a} to {measurement.b}" if measurement.kind == "distance" else f"start of {measurement.b}"
    if measurement.kind == "start" and frame_run != measurement.a:
        what += f" from that of {measurement.a}"
    values = [] if measurement.in_map is None else measurement.in_map.tolist()
    figures = f"{values[0]:.3f} m" if len(values) == 1 else "x {:.3f} m, y {:.3f} m, {:.4f} rad".format(*values)
    off = "nothing else determines it" if measurement.off_sigmas is None else f"off by {measurement.off_sigmas:.1f}"
    unit = "" if measurement.off_sigmas is None else " sigma"
    if measurement.component is None:
        return (
            f"measured {what}: {measurement.measured.item():.3f} m given, {figures} without it ({off}{unit}; not used)"
        )
    return f"measured {what}: {figures} in the map ({off}{unit})"


def _noise_lines(fit: FittedNoise) -> list[str]:
    """Return what was fitted, with its 99 % interval, and what was not."""
    fitted = [
        f"{each.name} {each.value:.3g} ({each.low:.3g} to {each.high:.3g})" for each in fit.parameters if not each.kept
    ]
    lines = []
    if fitted:
        lines.append(f"noise fitted to {plural(len(fit.runs), 'run')} (99 % interval): " + ", ".join(fitted))
    kept: dict[str, list[str]] = {}
    for each in fit.parameters:
        if each.kept not in ("", NOT_NEEDED):
            kept.setdefault(each.kept, []).append(f"{each.name} {each.value:.3g}")
    lines += [f"noise not fitted, since {why}: " + ", ".join(names) for why, names in kept.items()]
    return lines


def _floor_lines(result: MapResult) -> list[str]:
    """Return how uneven the floor is, if corners were used."""
    several = len(result.components) > 1
    lines = []
    for i, floor in enumerate(component.floor for component in result.components):
        if floor is not None and (floor.sigma_tilt_rad or floor.sigma_height_m):
            lines.append(
                f"floor{f' of component {i + 1}' if several else ''}: roll and pitch vary by "
                f"{degrees(floor.sigma_tilt_rad):.2f} deg and the height by {1000.0 * floor.sigma_height_m:.1f} mm "
                "(standard deviations)"
            )
    return lines
