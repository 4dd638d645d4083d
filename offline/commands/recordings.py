"""`groundsbot-offline live`: options of the command that follows recordings under way."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from groundsbot.offline.commands.drives import NoiseFile, RobotFiles, WorkerCount
from groundsbot.offline.commands.terminal import echo_lines
from groundsbot.offline.errors import OfflineError


def live(
    runs: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN...",
            help="Run folders, folders of runs (not with --map) or log files; they may be missing yet. With --map also "
            "ws://HOST:PORT, where `groundsbot-onboard record --foxglove` serves a run's topics: poses are newer then.",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder of the map that is made.", metavar="DIR")
    ] = None,
    known: Annotated[
        Path | None,
        typer.Option(
            "--map", help="Folder of a finished map: instead of a map, make poses in that one.", metavar="MAP"
        ),
    ] = None,
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
            help="Serve a page with the map, what is missing and advice; with a port alone, on this computer only.",
            metavar="[HOST:]PORT",
        ),
    ] = None,
    poses: Annotated[
        str | None,
        typer.Option(
            help="With --map: serve poses as lines of JSON on a TCP port, for programs on this computer.",
            metavar="PORT",
        ),
    ] = None,
    foxglove: Annotated[
        str | None,
        typer.Option(
            help="Serve map and poses to Foxglove and Lichtblick; with a port alone, on this computer only.",
            metavar="[HOST:]PORT",
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

    With --map each robot is localised in a finished map instead, in the frame of its largest component, until its run
    ends; each pose has its age, by this computer's clock.
    """
    if known is not None and output is None:
        from groundsbot.offline.commands.live_poses import PosesOptions, follow_poses

        unused = {"--noise": noise, "--page": page, "--workers": workers, "--overwrite": overwrite or None}
        _refuse(unused, "--map, which makes no map; leave it out")
        follow_poses(PosesOptions(runs, known, robot or (), period_s, poses, foxglove))
        return
    if output is None or known is not None:
        raise typer.BadParameter("give either -o, for a map of the runs, or --map, for poses in a finished one")
    _refuse({"--poses": poses}, "-o; give --map, the finished map in which poses are")
    from groundsbot.offline.live import is_address

    for each in filter(is_address, runs):
        raise OfflineError(f"{each}: live topics are for --map; give the run's folder, as a map needs the whole run")
    from groundsbot.offline.commands.live_drives import LiveOptions, follow
    from groundsbot.offline.commands.map_drives import exit_code
    from groundsbot.offline.commands.map_summary import summary

    paths = [Path(each) for each in runs]
    result = follow(LiveOptions(paths, output, robot or (), noise, period_s, overwrite, workers, page, foxglove))
    echo_lines(summary(result, output))
    raise typer.Exit(exit_code(result))


def _refuse(options: Mapping[str, object], why: str) -> None:
    for name, value in options.items():
        if value is not None:
            raise OfflineError(f"{name}: is not for {why}")
