"""`groundsbot-offline compare` and `export`: options of the commands that take a finished map."""

from pathlib import Path
from typing import Annotated, Final

import typer

from groundsbot.calib.foundation import echo
from groundsbot.offline.commands.arguments import JsonFlag
from groundsbot.offline.commands.terminal import echo_lines
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.export import ExportFormat, LayoutForm

_LAYOUTS: Final = "Layouts of tags (frc, limelight)"  # a group of options in the help
MapFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `map -o DIR` wrote.")]


def compare(
    folder: MapFolder,
    truth: Annotated[Path | None, typer.Option(help="truth.json of the simulation.")] = None,
    survey: Annotated[
        Path | None,
        typer.Option(help="Measured positions: CSV of tag_id,x_m,y_m, or WPILib's layout (.json)."),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(help="With --survey: new file (PNG) that shows the map and the survey in one plot."),
    ] = None,
    json_output: JsonFlag = False,
) -> None:
    """Compare a map with ground truth or a survey: errors, and whether its covariances are consistent (NEES).

    A survey is aligned first, and its entries that look wrong are named. With several components the figures of the
    largest come first, then those of the others, each in its own frame.
    """
    import json

    from groundsbot.offline.commands.library import compare_map
    from groundsbot.offline.evaluation import SurveyErrors
    from groundsbot.offline.maps import read_map
    from groundsbot.offline.report import write_survey_picture

    if picture is not None and survey is None:
        raise OfflineError("--picture: draws a survey over the map; give --survey, or leave it out")
    if (truth is None) == (survey is None):
        raise typer.BadParameter("give either --truth or --survey")
    result = read_map(folder)
    errors = compare_map(result, truth=truth, survey=survey)
    if picture is not None and isinstance(errors, SurveyErrors):
        write_survey_picture(result, errors, picture)
    if json_output:
        typer.echo(json.dumps(errors.as_json(), indent=2, allow_nan=False))
        return
    echo_lines(errors.lines())
    if picture is not None:
        echo(f"picture: {picture}")


def export(
    folder: MapFolder,
    form: Annotated[ExportFormat, typer.Option("--format", help="What to write.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="New file; for tum, csv and foxglove a new folder.")
    ],
    component: Annotated[
        int | None, typer.Option(min=1, help="Component of the map, from 1, if it has several: each has its own frame.")
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            help="geojson: origin of the map's frame, LAT_DEG,LON_DEG,HEADING_DEG (WGS 84; of its x axis, clockwise "
            "from north)."
        ),
    ] = None,
    tag_poses: Annotated[
        Path | None,
        typer.Option(
            help="Copy of tags.csv with measured values filled in under z_m and yaw_rad.", rich_help_panel=_LAYOUTS
        ),
    ] = None,
    tag_height_m: Annotated[
        float | None,
        typer.Option(help="Height of tags that have none in --tag-poses or the map.", rich_help_panel=_LAYOUTS),
    ] = None,
    face_viewers: Annotated[
        bool,
        typer.Option(
            "--face-viewers",
            help="Assume tags face their observers; errors are tens of degrees.",
            rich_help_panel=_LAYOUTS,
        ),
    ] = False,
    field_m: Annotated[
        str | None, typer.Option(help="frc: size of the field, LENGTH,WIDTH.", rich_help_panel=_LAYOUTS)
    ] = None,
    family: Annotated[
        str | None, typer.Option(help="frc: the family to write; a layout holds only one.", rich_help_panel=_LAYOUTS)
    ] = None,
    layout_form: Annotated[
        LayoutForm | None,
        typer.Option(
            help="frc: `tags` as WPILib's AprilTagFieldLayout reads it (default), or `field-tags` as its Field does.",
            rich_help_panel=_LAYOUTS,
        ),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(
            help="Frame of what is written, as for `map`: with FILE, a survey or a layout, the map is aligned to its "
            "tags. [default: the map's]",
            metavar="start[:RUN]|shape|A,B|FILE",
        ),
    ] = None,
) -> None:
    """Write a finished map in the formats of other tools: graph, trajectories, positions, layouts of tags, viewers.

    Nothing is overwritten, and nothing is assumed silently: what a format needs and a map does not hold is an option.
    """
    from groundsbot.offline.commands.library import export_map

    said = export_map(
        folder,
        form,
        output,
        component=None if component is None else component - 1,
        origin=origin,
        tag_poses=tag_poses,
        tag_height_m=tag_height_m,
        face_viewers=face_viewers,
        field_m=field_m,
        family=family,
        layout_form=layout_form,
        frame=frame,
    )
    echo_lines(said)
