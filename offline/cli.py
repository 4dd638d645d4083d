"""groundsbot-offline: from run logs to a map, and what goes with it. Heavy imports wait until a command runs."""

from pathlib import Path
from typing import Annotated

import typer

from calib.command_line import EXIT_WITH_LOSSES, new_app
from calib.command_line import run as run_program
from calib.errors import GroundsbotError
from offline.export_options import ExportFormat, ExportOptions
from offline.import_cli import import_recording
from offline.map_model import MapModel
from offline.self_calibration_option import AUTO, OFF

app = new_app("Turns run logs into one map of tags and trajectories, and tells what is in them.")

JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


app.command("import")(import_recording)


@app.command("map")
def map_command(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Log files, run folders or folders of runs.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the map.", metavar="DIR")],
    robot: Annotated[
        list[Path] | None,
        typer.Option(help="robot.yaml to use instead of the one in the logs of that robot; repeatable."),
    ] = None,
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
    distance: Annotated[
        list[str] | None,
        typer.Option(help="Between two runs' starts or tags, as measured: A,B=metres,sigma_m; repeatable."),
    ] = None,
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
    ] = OFF,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the map in DIR.")] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Also print time and memory of each stage; `stages` in JSON.")
    ] = False,
    json_output: JsonFlag = False,
) -> None:
    """Turns the drives in logs into one map of all tags and trajectories, in the frame of the first log's start.

    Exit 3: the runs do not all hang together, so that the map has several components; or a log is damaged, and the map
    is without what is lost of it. Which of these is printed.
    """
    from offline.map_command import MapOptions, as_json, exit_code, make_map, stage_lines, summary

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
        for line in [*summary(result, output), *(stage_lines(costs) if verbose else [])]:
            typer.echo(line)
    raise typer.Exit(exit_code(result))


@app.command()
def calibrate(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Log files, run folders or folders of runs.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="New robot.yaml; or a new folder, for several robots.", metavar="OUT")
    ],
    robot: Annotated[
        list[Path] | None,
        typer.Option(help="robot.yaml to use instead of the one in the logs of that robot; repeatable."),
    ] = None,
    noise: Annotated[Path | None, typer.Option(help="YAML with noise parameters, instead of fitting them.")] = None,
    distance: Annotated[
        list[str] | None,
        typer.Option(help="Between two runs' starts or tags, as measured: A,B=metres,sigma_m; repeatable."),
    ] = None,
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

    from offline.calibrate_command import CalibrateOptions, as_json, calibrate_robots, summary

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


@app.command()
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

    from offline.localize_command import LocalizeOptions, as_json, exit_code, localize_log, summary

    found = localize_log(LocalizeOptions(log, folder, output, robot or (), noise, component, overwrite))
    if json_output:
        typer.echo(json.dumps(as_json(found), indent=2, allow_nan=False))
    else:
        for line in summary(found, output):
            typer.echo(line)
    raise typer.Exit(exit_code(found))


@app.command()
def info(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Log files, run folders or folders of runs.")],
    json_output: JsonFlag = False,
) -> None:
    """Tells what logs hold: run, robot, duration, rates, distance, tags, gaps, events, sizes.

    A log that cannot be read is named at the end, with exit 1; the others are described all the same. Exit 3: something
    of a log is lost, and it is said what.
    """
    import json

    from offline.info import describe_log
    from onboard.allowance import Allowance
    from onboard.log_reader import find_logs

    described, refused, allowance = [], [], Allowance()
    for log in find_logs(logs):
        try:
            described.append(describe_log(log, allowance))
        except GroundsbotError as error:
            refused.append(error)
    if json_output:
        typer.echo(json.dumps([each.as_json() for each in described], indent=2, allow_nan=False))
    else:
        for line in (line for each in described for line in each.lines()):
            typer.echo(line)
    for earlier in refused[:-1]:
        typer.echo(f"error: {earlier}", err=True)
    if refused:
        raise refused[-1]
    if any(each.lost for each in described):
        raise typer.Exit(EXIT_WITH_LOSSES)


@app.command()
def salvage(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log file or run folder, damaged or unfinished.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="New log file or run folder.")],
) -> None:
    """Writes what a damaged or unfinished log still holds into a new one, finished and with an index.

    The old log is not touched. Exit 3: something of it is lost; it is said what.
    """
    from offline.salvage import salvage as make_salvage

    salvaged = make_salvage(log, output)
    for line in (line for each in salvaged for line in each.lines()):
        typer.echo(line)
    if not all(each.is_whole for each in salvaged):
        raise typer.Exit(EXIT_WITH_LOSSES)


@app.command()
def detect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log file or run folder that holds pictures.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="New run folder, or new .mcap file.")],
    family: Annotated[
        list[str] | None, typer.Option(help="Family to look for; repeatable. [default: those in the log's robot.yaml]")
    ] = None,
    decimate: Annotated[
        float, typer.Option(min=1.0, max=8.0, help="Search at a fraction of the picture's size; 1 finds the smallest.")
    ] = 1.0,
    detector: Annotated[
        str | None, typer.Option(help="pupil-apriltags or pyapriltags. [default: as in the log's robot.yaml]")
    ] = None,
    drop_others: Annotated[
        bool, typer.Option("--drop-others", help="Leave out the old detections of pictures that were not kept.")
    ] = False,
    processes: Annotated[int | None, typer.Option(min=1, help="[default: one for each core]")] = None,
) -> None:
    """Looks for tags again in the pictures of a log; writes a new log that keeps all else.

    The old log is not touched. Exit 3: pictures are of no use, or the log is damaged; it is said what.
    """
    from offline.detect import DetectOptions, detect_again
    from offline.progress import progress_bar

    options = DetectOptions(tuple(family) if family else None, detector, decimate, drop_others, processes)
    with progress_bar() as show:
        report = detect_again(log, output, options, show)
    for line in report.lines():
        typer.echo(line)
    if report.n_unusable or report.losses.in_words:
        raise typer.Exit(EXIT_WITH_LOSSES)


@app.command()
def compare(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="What `map -o DIR` wrote.")],
    truth: Annotated[Path | None, typer.Option(help="truth.json of the simulation.")] = None,
    survey: Annotated[
        Path | None, typer.Option(help="Measured places of tags: tag_id,x_m,y_m, maybe sigma_m, family, instance.")
    ] = None,
    json_output: JsonFlag = False,
) -> None:
    """Tells how far a map is from ground truth or from a survey, and whether its covariances are honest.

    A survey is aligned first, and its entries that look wrong are named. With several components the figures of the
    largest come first, then those of the others, each in its own frame.
    """
    import json

    from offline.evaluation import evaluate
    from offline.map_errors import MapErrors
    from offline.map_io import read_map
    from offline.survey import judge_survey, read_survey
    from offline.survey_errors import SurveyErrors
    from offline.truth import read_truth

    errors: MapErrors | SurveyErrors
    if truth is not None and survey is None:
        errors = evaluate(read_map(folder), read_truth(truth))
    elif survey is not None and truth is None:
        errors = judge_survey(read_map(folder), read_survey(survey))
    else:
        raise typer.BadParameter("give either --truth or --survey")
    if json_output:
        typer.echo(json.dumps(errors.as_json(), indent=2, allow_nan=False))
        return
    for line in errors.lines():
        typer.echo(line)


@app.command()
def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="What `map -o DIR` wrote.")],
    form: Annotated[ExportFormat, typer.Option("--format", help="What to write.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="New file; for tum and csv a new folder.")
    ],
    component: Annotated[
        int | None, typer.Option(min=0, help="Which one, where the map has several: each has a frame of its own.")
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            help="geojson: where the map's frame lies, LAT_DEG,LON_DEG,HEADING_DEG (WGS 84; of its x axis, clockwise "
            "from north)."
        ),
    ] = None,
    tag_poses: Annotated[
        Path | None,
        typer.Option(help="frc, limelight: copy of tags.csv in which z_m and yaw_rad are filled in, as measured."),
    ] = None,
    tag_height_m: Annotated[
        float | None,
        typer.Option(
            help="frc, limelight: taken for the height of tags of which neither --tag-poses nor the map tells."
        ),
    ] = None,
    face_viewers: Annotated[
        bool,
        typer.Option(
            "--face-viewers", help="frc, limelight: take tags to face where they were seen from, by tens of degrees."
        ),
    ] = False,
    field_m: Annotated[str | None, typer.Option(help="frc: size of the field, LENGTH,WIDTH.")] = None,
    family: Annotated[str | None, typer.Option(help="frc: the family to write, which a layout cannot tell.")] = None,
) -> None:
    """Writes a finished map in the form of other tools: a graph for g2o, trajectories, places, layouts of tags.

    Nothing is written over, and nothing made up: what a form needs and a map does not hold is an option.
    """
    from offline.export import export_map

    options = ExportOptions(form, output, component, origin, tag_poses, tag_height_m, face_viewers, field_m, family)
    for line in export_map(folder, options):
        typer.echo(line)


def main() -> None:
    """The program `groundsbot-offline`."""
    run_program(app)


if __name__ == "__main__":
    main()
