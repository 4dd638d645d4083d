"""`groundsbot-offline info`, `salvage` and `detect`: options of the commands that inspect or repair logs."""

from pathlib import Path
from typing import Annotated

import typer

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.foundation import EXIT_WITH_LOSSES, echo
from groundsbot.offline.commands.arguments import JsonFlag, LogArguments, log_of, logs_of
from groundsbot.offline.commands.terminal import echo_lines


def info(
    logs: LogArguments,
    json_output: JsonFlag = False,
) -> None:
    """Print what logs hold: run, robot, duration, rates, distance, tags, gaps, events, sizes.

    A log that cannot be read is named at the end, with exit 1; the others are described all the same. Exit 3: part of a
    log is lost; the loss is printed.
    """
    import json

    from groundsbot.offline.logs import describe_log
    from groundsbot.onboard.log import Allowance

    described, refused, allowance = [], [], Allowance()
    for log in logs_of(logs):
        try:
            described.append(describe_log(log, allowance))
        except GroundsbotError as error:
            refused.append(error)
    if json_output:
        typer.echo(json.dumps([each.as_json() for each in described], indent=2, allow_nan=False))
    else:
        echo_lines(line for each in described for line in each.lines())
    for earlier in refused[:-1]:
        echo(f"error: {earlier}", err=True)
    if refused:
        raise refused[-1]
    if any(each.lost for each in described):
        raise typer.Exit(EXIT_WITH_LOSSES)


def salvage(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log file or run folder, damaged or unfinished.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="New log file or run folder.")],
) -> None:
    """Write what a damaged or unfinished log still holds into a new one, complete and with an index.

    The old log is not changed. Exit 3: part of it is lost; the loss is printed.
    """
    from groundsbot.offline.logs import salvage as make_salvage

    salvaged = make_salvage(log_of(log), output)
    echo_lines(line for each in salvaged for line in each.lines())
    if not all(each.is_whole for each in salvaged):
        raise typer.Exit(EXIT_WITH_LOSSES)


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
        bool, typer.Option("--drop-others", help="Leave out the old detections of pictures that were not recorded.")
    ] = False,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Number of worker processes. [default: one for each core]")
    ] = None,
) -> None:
    """Detect tags again in the pictures of a log; write a new log with the new detections and all else.

    The old log is not changed. Exit 3: pictures cannot be used, or the log is damaged; the reason is printed.
    """
    from groundsbot.offline.commands.progress_bar import progress_bar
    from groundsbot.offline.logs import DetectOptions, detect_again

    options = DetectOptions(tuple(family) if family else None, detector, decimate, drop_others, processes)
    with progress_bar() as show:
        report = detect_again(log_of(log), output, options, show)
    echo_lines(report.lines())
    if report.n_unusable or report.losses.in_words:
        raise typer.Exit(EXIT_WITH_LOSSES)
