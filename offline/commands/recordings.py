"""`groundsbot-offline live`: options of the command that follows recordings under way."""

from pathlib import Path
from typing import Annotated

import typer

from groundsbot.offline.commands.drives import NoiseFile, RobotFiles, WorkerCount
from groundsbot.offline.commands.terminal import echo_lines


def live(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Run folders, folders of runs or log files; they may be missing yet."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the map.", metavar="DIR")],
    robot: RobotFiles = None,
    noise: NoiseFile = None,
    period_s: Annotated[
        float,
        typer.Option(
            "--period-s", min=0.1, max=3600.0, metavar="S", help="Time between updates, if these are quick enough."
        ),
    ] = 1.0,
    page: Annotated[
        str | None,
        typer.Option(
            help="Serve a page with the map, what is missing and advice, for a browser on this computer.",
            metavar="PORT",
        ),
    ] = None,
    workers: WorkerCount = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the map in DIR.")] = False,
) -> None:
    """Map recordings while they are made: all drives up to now, again every second.

    An update is one line: runs, metres driven, tags, components, shape, and the seconds it took. Lines below it name
    what is missing, such as tags that would join two runs, and what to drive next; they come when they change. DIR
    holds map.json of the newest update. When the recorders have finished all runs, it is replaced by the map that `map`
    makes of them, with all its files, and the exit code is that of `map`. Ctrl-C ends earlier and leaves map.json of
    the last update.
    """
    from groundsbot.offline.commands.live_drives import LiveOptions, follow
    from groundsbot.offline.commands.map_drives import exit_code
    from groundsbot.offline.commands.map_summary import summary

    result = follow(LiveOptions(runs, output, robot or (), noise, period_s, overwrite, workers, page))
    echo_lines(summary(result, output))
    raise typer.Exit(exit_code(result))
