"""`groundsbot-offline map`, `calibrate` and `localize`: their options, for commands that take drives."""

from pathlib import Path
from typing import Annotated

import typer

from groundsbot.calib.foundation import EXIT_WITH_LOSSES
from groundsbot.offline.commands.arguments import JsonFlag, LogArguments
from groundsbot.offline.maps import MapModel
from groundsbot.offline.self_calibration import AUTO

RobotFiles = Annotated[
    list[Path] | None,
    typer.Option(help="robot.yaml to use instead of the one in the logs of that robot; repeatable."),
]
Distances = Annotated[
    list[str] | None,
    typer.Option(help="Between two runs' starts or tags, as measured: A,B=metres,sigma_m; repeatable."),
]


def map_command(
    logs: LogArguments,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the map.", metavar="DIR")],
    robot: RobotFiles = None,
    noise: Annotated[
        Path | None, typer.Option(help="YAML with noise parameters, instead of fitting them; the others keep defaults.")
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="A run's start, as measured in the map: RUN=x_m,y_m,theta_rad,sigma_x_m,sigma_y_m,sigma_theta_rad; "
            "repeatable.",
            metavar="START",
        ),
    ] = None,
    distance: Distances = None,
    extend: Annotated[
        Path | None,
        typer.Option(help="map.json of a map that is kept: its runs and the logs' in one new map, under its noise."),
    ] = None,
    keep_suspects: Annotated[
        bool, typer.Option("--keep-suspects", help="Name tags that do not belong, but keep them as one tag each.")
    ] = False,
    model: Annotated[
        MapModel,
        typer.Option(
            help="What the map is solved on last: tags' corners in pixels, or their places on the floor only."
        ),
    ] = MapModel.FLOOR,
    upright_deg: Annotated[
        float | None,
        typer.Option(
            help="All tags hang upright, faces vertical and edges level, to this sigma in degrees; only with --model "
            "corners.",
        ),
    ] = None,
    calibrate: Annotated[
        str,
        typer.Option(
            help="Which numbers of robot.yaml the drives may set beyond its sigmas: off, auto (those that drives "
            "contradict), or names.",
            metavar="off|auto|PARAM,...",
        ),
    ] = AUTO,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the map in DIR.")] = False,
    verbose: Annotated[
        bool,
        typer.Option("-v", "--verbose", help="Print all that was found, and what each stage took (`stages` in JSON)."),
    ] = False,
    json_output: JsonFlag = False,
) -> None:
    """Turns the drives in logs into one map of all tags and trajectories, in the frame of the first log's start.

    Exit 3: the runs do not all hang together, so that the map has several components; a log is damaged, and the map is
    without what is lost of it; or drives contradict the model, and all sigmas are larger for it. Which of these is
    printed.
    """
    from groundsbot.offline.commands.map_drives import MapOptions, as_json, exit_code, make_map, stage_lines, summary

    options = MapOptions(
        logs,
        output,
        robot or (),
        noise,
        overwrite,
        start or (),
        distance or (),
        keep_suspects,
        corners=model is MapModel.CORNERS,
        upright_deg=upright_deg,
        extend=extend,
        calibrate=calibrate,
    )
    result, costs = make_map(options)
    if json_output:
        typer.echo(as_json(result, costs if verbose else None))
    else:
        for line in [*summary(result, output, verbose=verbose), *(stage_lines(costs) if verbose else [])]:
            typer.echo(line)
    raise typer.Exit(exit_code(result))


def calibrate(
    logs: LogArguments,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="New robot.yaml; or a new folder, for several robots.", metavar="OUT")
    ],
    robot: RobotFiles = None,
    noise: Annotated[Path | None, typer.Option(help="YAML with noise parameters, instead of fitting them.")] = None,
    distance: Distances = None,
    model: Annotated[
        MapModel, typer.Option(help="Ask tags' corners in pixels (focal length too), or their places on the floor.")
    ] = MapModel.FLOOR,
    calibrate: Annotated[str, typer.Option(help="As for `map`: what is freed.", metavar="auto|PARAM,...")] = AUTO,
    json_output: JsonFlag = False,
) -> None:
    """Learns wheels, track, camera mount and tag sizes from drives: a robot.yaml with the map's values and sigmas.

    The camera's file is written beside it. Of each number it says what was learnt, and which drive would tell more.
    The drives need not hang together. Exit 3: a log is damaged, and the rest of it was used.
    """
    import json

    from groundsbot.offline.commands.calibrate_robots import CalibrateOptions, as_json, calibrate_robots, summary

    options = CalibrateOptions(
        logs, output, robot or (), noise, distance or (), corners=model is MapModel.CORNERS, calibrate=calibrate
    )
    calibrated = calibrate_robots(options)
    if json_output:
        typer.echo(json.dumps(as_json(calibrated), indent=2, allow_nan=False))
    else:
        for line in summary(calibrated):
            typer.echo(line)
    if calibrated.result.losses:
        raise typer.Exit(EXIT_WITH_LOSSES)


def localize(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log file or run folder.")],
    folder: Annotated[Path, typer.Option("--map", help="What `map -o DIR` wrote; it stays as it is.", metavar="DIR")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder of the trajectory.", metavar="OUT")
    ] = None,
    robot: Annotated[list[Path] | None, typer.Option(help="robot.yaml to use instead of the one in the log.")] = None,
    noise: Annotated[Path | None, typer.Option(help="YAML with noise parameters, instead of the map's.")] = None,
    component: Annotated[
        int | None, typer.Option(min=0, help="Where to look, if the map has several. [default: where the tags fit]")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the trajectory in OUT.")] = False,
    json_output: JsonFlag = False,
) -> None:
    """Tells where a new run drove in a finished map, wherever it started; with covariances, the map's included.

    Tags that were moved since are named and not used. Exit 3: the place of some of it is ambiguous or not told, or the
    log is damaged; it is said what.
    """
    import json

    from groundsbot.offline.commands.localize_drive import LocalizeOptions, as_json, exit_code, localize_log, summary

    found = localize_log(LocalizeOptions(log, folder, output, robot or (), noise, component, overwrite))
    if json_output:
        typer.echo(json.dumps(as_json(found), indent=2, allow_nan=False))
    else:
        for line in summary(found, output):
            typer.echo(line)
    raise typer.Exit(exit_code(found))
