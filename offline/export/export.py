"""Export of a finished map for other tools; docs/formats.md gives units and frames of each format."""

import csv
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from groundsbot.calib.foundation import atomic_write, folder_written_whole, plural
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.export.foxglove import write_foxglove
from groundsbot.offline.export.frame import in_frame_of
from groundsbot.offline.export.frc_layout import fmap_of, frc_layout_of
from groundsbot.offline.export.g2o import g2o_text
from groundsbot.offline.export.geojson import geojson_of
from groundsbot.offline.export.options import ExportFormat, ExportOptions
from groundsbot.offline.export.rerun_file import write_rerun
from groundsbot.offline.maps import Component, MapResult, RunResult, read_map, tags_csv, write_tum

RUN_COLUMNS: Final = ("t_ns", "x_m", "y_m", "theta_rad")

Lines = list[str]


def export_map(folder: Path, options: ExportOptions) -> Lines:
    """Write one component of a map.

    Args:
        folder: folder of the map that `map -o` wrote.
        options: format, output and what the format needs besides.

    Returns:
        Lines for the user.

    Raises:
        GroundsbotError: the output exists, or the map does not hold what the format needs; nothing is written then.
    """
    options.check()
    if os.path.lexists(options.output):
        raise OfflineError(f"-o {options.output}: exists already and is not overwritten; give another output")
    result = read_map(folder)
    component = _component(result, options.component)
    warnings: tuple[str, ...] = ()
    if options.frame is not None:
        component, warnings = in_frame_of(component, options.frame)
    try:
        if options.form in _FOLDERS:
            with folder_written_whole(options.output) as partial:
                _FOLDERS[options.form](component, partial)
            lines = [_describe(component)]
        elif options.form == ExportFormat.RERUN:
            with atomic_write(options.output) as partial:
                write_rerun(component, partial)
            lines = [_describe(component)]
        else:
            text, lines = _TEXTS[options.form](component, result, options)
            with atomic_write(options.output) as partial:
                partial.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OfflineError(
            f"-o {options.output}: cannot be written ({error.strerror}); choose another place"
        ) from error
    lines += [f"warning: {warning}" for warning in warnings]
    return [*lines, *_outlier_lines(result, component), f"{options.form}: {options.output}"]


def _component(result: MapResult, index: int | None) -> Component:
    """Return the one asked for, or the only one."""
    n = len(result.components)
    if index is None and n == 1:
        return result.components[0]
    which = ", ".join(
        f"{i + 1} (frame of {each.frame_owner}, {plural(len(each.runs), 'run')}, {plural(len(each.tags), 'tag')})"
        for i, each in enumerate(result.components)
    )
    if index is None:
        raise OfflineError(f"the map has {n} components, each in its own frame; choose one with --component: {which}")
    if index >= n:
        raise OfflineError(f"--component {index + 1}: the map has no such component; choose among {which}")
    return result.components[index]


def _outlier_lines(result: MapResult, component: Component) -> Lines:
    """Return a warning for each tag with outliers, as other tools' formats cannot mark them."""
    there = {(tag.family, tag.tag_id) for tag in component.tags}
    return [f"warning: suspect: {each.line()}" for each in result.outliers if (each.family, each.tag_id) in there]


def _describe(component: Component) -> str:
    runs, tags = plural(len(component.runs), "run"), plural(len(component.tags), "tag")
    frame = f"{component.frame_owner}'s start" if component.datum is None else component.frame_owner
    return f"{runs}, {tags}, in the frame of {frame}"


def _write_tum(component: Component, folder: Path) -> None:
    for run in component.runs:
        write_tum(folder / f"{run.name}.tum", run.stamps_ns, run.T_map_base)


def _write_csv(component: Component, folder: Path) -> None:
    (folder / "tags.csv").write_text(tags_csv([component]), encoding="utf-8")
    for run in component.runs:
        (folder / f"{run.name}.csv").write_text(_run_csv(run), encoding="utf-8")


def _run_csv(run: RunResult) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(RUN_COLUMNS)
    for stamp_ns, (x, y, theta) in zip(run.stamps_ns.tolist(), run.T_map_base.tolist(), strict=True):
        writer.writerow((stamp_ns, f"{x:.9f}", f"{y:.9f}", f"{theta:.12f}"))
    return stream.getvalue()


def _g2o(component: Component, result: MapResult, _options: ExportOptions) -> tuple[str, Lines]:
    lines = [_describe(component)]
    used = {each.component for each in result.measurements}
    if any(each.runs[0].name == component.runs[0].name and i in used for i, each in enumerate(result.components)):
        lines.append("warning: --start and --distance measurements are not exported; the graph's optimum differs")
    return g2o_text(component), lines


def _geojson(component: Component, _result: MapResult, options: ExportOptions) -> tuple[str, Lines]:
    return _as_json(geojson_of(component, options)), [_describe(component)]


def _frc(component: Component, _result: MapResult, options: ExportOptions) -> tuple[str, Lines]:
    layout, said = frc_layout_of(component, options)
    return _as_json(layout), said


def _limelight(component: Component, _result: MapResult, options: ExportOptions) -> tuple[str, Lines]:
    fmap, said = fmap_of(component, options)
    return _as_json(fmap), said


def _as_json(data: dict[str, Any]) -> str:
    return json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


_FOLDERS: Final[dict[ExportFormat, Callable[[Component, Path], None]]] = {
    ExportFormat.TUM: _write_tum,
    ExportFormat.CSV: _write_csv,
    ExportFormat.FOXGLOVE: write_foxglove,
}
_TEXTS: Final[dict[ExportFormat, Callable[[Component, MapResult, ExportOptions], tuple[str, Lines]]]] = {
    ExportFormat.G2O: _g2o,
    ExportFormat.GEOJSON: _geojson,
    ExportFormat.FRC: _frc,
    ExportFormat.LIMELIGHT: _limelight,
}
