"""`groundsbot-offline map`, `calibrate` and `localize`: options of the commands that take drives."""

from pathlib import Path
from typing import Annotated, Final

import typer

from groundsbot.calib.foundation import EXIT_WITH_LOSSES
from groundsbot.offline.commands.arguments import MODELS, DriveArguments, JsonFlag, logs_of, parse_model, workers_for
from groundsbot.offline.commands.terminal import echo_lines
from groundsbot.offline.maps import MapModel
from groundsbot.offline.self_calibration import AUTO

# Groups of options in the help.
_KNOWN: Final = "Inputs besides the logs"
_ESTIMATE: Final = "Estimate"
RobotFiles = Annotated[
    list[Path] | None,
    typer.Option(
        help="robot.yaml to use instead of the one in the logs of that robot; repeatable.", rich_help_panel=_KNOWN
    ),
]
NoiseFile = Annotated[
    Path | None,
    typer.Option(
        help="YAML with noise parameters, instead of fitting them; others have defaults.", rich_help_panel=_KNOWN
    ),
]
Distances = Annotated[
    list[str] | None,
    typer.Option(
        help="Measured distance between two runs' starts or tags: A,B=metres,sigma_m; repeatable.",
        rich_help_panel=_KNOWN,
    ),
]
WorkerCount = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=256,
        help="Number of worker processes; the result does not depend on it. [default: one for each core, fewer if "
        "memory does not suffice]",
        metavar="N",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Scheduler of a Dask cluster, whose workers take the place of --workers; the result is the same. All see "
        "the logs under the same paths or URLs (docs/cluster.md).",
        metavar="tcp://HOST:PORT",
    ),
]


def map_command(
    logs: DriveArguments,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the map.", metavar="DIR")],
    robot: RobotFiles = None,
    noise: NoiseFile = None,
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Measured start of a run, from the first one's: RUN=x_m,y_m,theta_rad,sigma_x_m,sigma_y_m,"
            "sigma_theta_rad; repeatable.",
            metavar="START",
            rich_help_panel=_KNOWN,
        ),
    ] = None,
    distance: Distances = None,
    extend: Annotated[
        Path | None,
        typer.Option(
            help="map.json of an earlier map: make one new map of its runs and the logs, with its noise.",
            rich_help_panel=_KNOWN,
        ),
    ] = None,
    keep_suspects: Annotated[
        bool,
        typer.Option(
            "--keep-suspects", help="Report tags with outliers, but keep each as one tag.", rich_help_panel=_ESTIMATE
        ),
    ] = False,
    model: Annotated[
        MapModel,
        typer.Option(
            help="Measurements of the final solve: tags' corners in pixels, or their positions on the floor.",
            parser=parse_model,
            metavar=MODELS,
            rich_help_panel=_ESTIMATE,
        ),
    ] = MapModel.FLOOR,
    upright_deg: Annotated[
        float | None,
        typer.Option(
            help="Assume that all tags are upright (faces vertical, edges level), with this sigma in degrees; only "
            "with --model corners.",
            rich_help_panel=_ESTIMATE,
        ),
    ] = None,
    calibrate: Annotated[
        str,
        typer.Option(
            help="Parameters of robot.yaml to estimate freely, regardless of its sigmas: off, auto (those that drives "
            "contradict), or names.",
            metavar="off|auto|PARAM,...",
            rich_help_panel=_ESTIMATE,
        ),
    ] = AUTO,
    frame: Annotated[
        str,
        typer.Option(
            help="Frame of the map: the first run's start, another run's, the tags' own axes (least covariance), "
            "those from tag A towards tag B, or a survey's, as `compare` reads it.",
            metavar="start[:RUN]|shape|A,B|FILE",
            rich_help_panel=_ESTIMATE,
        ),
    ] = "start",
    workers: WorkerCount = None,
    scheduler: Scheduler = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the map in DIR.")] = False,
    verbose: Annotated[
        bool,
        typer.Option("-v", "--verbose", help="Print all results, and the cost of each stage (`stages` in JSON)."),
    ] = False,
    json_output: JsonFlag = False,
) -> None:
    """Make one map of all tags and trajectories from the drives in logs.

    Exit 3: the runs are not all connected, so that the map has several components; or a log is damaged, and lost parts
    are missing in the map; or drives contradict the model, and all sigmas were increased; or a solve did not converge.
    The reason is printed.
    """
    with workers_for(logs_of(logs), scheduler, workers) as started:  # these load libraries while this process does
        from groundsbot.offline.commands.map_drives import MapOptions, as_json, exit_code, make_map
        from groundsbot.offline.commands.map_summary import stage_lines, summary

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
            frame=frame,
            workers=workers,
            scheduler=scheduler,
        )
        result, costs = make_map(options, started)
    if json_output:
        typer.echo(as_json(result, costs if verbose else None))
    else:
        echo_lines([*summary(result, output, verbose=verbose), *(stage_lines(costs) if verbose else [])])
    raise typer.Exit(exit_code(result))


def calibrate(
    logs: DriveArguments,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="New robot.yaml; or a new folder, for several robots.", metavar="OUT")
    ],
    robot: RobotFiles = None,
    noise: Annotated[
        Path | None, typer.Option(help="YAML with noise parameters, instead of fitting them.", rich_help_panel=_KNOWN)
    ] = None,
    distance: Distances = None,
    model: Annotated[
        MapModel,
        typer.Option(
            help="Use tags' corners in pixels (focal length too), or their positions on the floor.",
            parser=parse_model,
            metavar=MODELS,
            rich_help_panel=_ESTIMATE,
        ),
    ] = MapModel.FLOOR,
    calibrate: Annotated[
        str, typer.Option(help="Parameters to free, as for `map`.", metavar="auto|PARAM,...", rich_help_panel=_ESTIMATE)
    ] = AUTO,
    workers: WorkerCount = None,
    scheduler: Scheduler = None,
    json_output: JsonFlag = False,
) -> None:
    """Estimate wheels, track, camera mount and tag sizes from drives: a robot.yaml with the map's values and sigmas.

    The camera's file is written beside it. A table compares each parameter with robot.yaml; below it stand the drives
    that would determine the others. The drives need not be connected. Exit 3: a log is damaged, and the rest of it was
    used; or a solve did not converge.
    """
    import json

    from groundsbot.offline.commands.calibrate_robots import CalibrateOptions, as_json, calibrate_robots, summary

    options = CalibrateOptions(
        logs,
        output,
        robot or (),
        noise,
        distance or (),
        corners=model is MapModel.CORNERS,
        calibrate=calibrate,
        workers=workers,
        scheduler=scheduler,
    )
    calibrated = calibrate_robots(options)
    if json_output:
        typer.echo(json.dumps(as_json(calibrated), indent=2, allow_nan=False))
    else:
        echo_lines(summary(calibrated))
    if calibrated.result.losses or not all(each.converged for each in calibrated.result.components):
        raise typer.Exit(EXIT_WITH_LOSSES)


def localize(
    logs: DriveArguments,
    folder: Annotated[Path, typer.Option("--map", help="Folder of `map -o DIR`; it is not changed.", metavar="DIR")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder of the trajectories.", metavar="OUT")
    ] = None,
    robot: RobotFiles = None,
    noise: Annotated[
        Path | None, typer.Option(help="YAML with noise parameters, instead of the map's.", rich_help_panel=_KNOWN)
    ] = None,
    component: Annotated[
        int | None,
        typer.Option(min=1, help="Component of the map, from 1, if it has several. [default: where the tags fit]"),
    ] = None,
    workers: WorkerCount = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the trajectories in OUT.")] = False,
    json_output: JsonFlag = False,
) -> None:
    """Localise new runs in a finished map, wherever they started; with covariances, the map's included.

    Each run is localised on its own. Tags that were moved since are reported and not used. Exit 3: part of a run is
    ambiguous or not located, a log is damaged, or a solve did not converge; the reason is printed.
    """
    import json

    from groundsbot.offline.commands.localize_drive import LocalizeOptions, as_json, exit_code, localize_logs, summary

    index = None if component is None else component - 1
    options = LocalizeOptions(logs, folder, output, robot or (), noise, index, overwrite, workers)
    found = localize_logs(options)
    if json_output:
        typer.echo(json.dumps(as_json(found), indent=2, allow_nan=False))
    else:
        echo_lines(summary(found, output))
    raise typer.Exit(exit_code(found))
