"""The program groundsbot-onboard, for the robot's computer."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from groundsbot.calib.board import DEFAULT_BOARD, DEFAULT_VIEWS
from groundsbot.calib.foundation import EXIT_REFUSED, EXIT_WITH_LOSSES, echo, new_app, run

if TYPE_CHECKING:
    from groundsbot.calib.web import PageAddress

PRIORITY = -10  # nice value of the recorder

app = new_app("Record a drive of a robot (wheels, camera and detected tags, on one clock), and prepare for it.")

RobotOption = Annotated[Path, typer.Option("--robot", metavar="FILE", help="The robot's robot.yaml.")]


@app.command()
def record(
    robot: RobotOption,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for run folders; may exist.")],
    status: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Status file, written each second.  [default: DIR/ROBOT.status.json]"),
    ] = None,
    page: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:]PORT",
            help="Serve a page to watch and control the recording; with a port alone, on this computer only.  "
            "[default: recorder.page of robot.yaml]",
        ),
    ] = None,
    foxglove: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:]PORT",
            help="Serve the log's topics to Foxglove and Lichtblick as they are recorded; with a port alone, on this "
            "computer only.  [default: recorder.foxglove of robot.yaml]",
        ),
    ] = None,
) -> None:
    """Record one run until stopped (Ctrl-C, SIGTERM, or the end of the terminal).

    Writes DIR/RUN_ID/0000.core.mcap, and 0000.camera.mcap if pictures are kept. The recorder waits for missing devices
    and reopens lost ones. A camera may be a folder: it provides the pictures that appear in it as T.png or T.jpg,
    where T is the middle of the exposure in ns of the host's wall clock (CLOCK_REALTIME). Paths in robot.yaml are
    relative to the folder of that file.

    --page 0.0.0.0:8080 serves a page for a phone at all addresses of this computer: the cameras' pictures with the tags
    found, rates, losses, warnings; it can stop the run, start another one, and write notes into the log. The URL that
    is printed has a secret.

    Exit code 0: nothing was lost; 3: data were lost, as the last lines and the log say.
    """
    import contextlib
    import os
    import sys

    from groundsbot.onboard.monitoring import STATUS_SUFFIX, Recording
    from groundsbot.onboard.page import Addresses, record_and_serve
    from groundsbot.onboard.process import ConsoleLines, stop_event
    from groundsbot.onboard.recorder import RobotFiles

    stop = stop_event()
    with contextlib.suppress(OSError):  # may be forbidden; the kernel buffers wheel lines for tens of ms only
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    files = RobotFiles(robot)
    options = files.robot.recorder
    addresses = Addresses(_address("--page", page, options.page), _address("--foxglove", foxglove, options.foxglove))
    path = status or output / f"{files.robot.robot_id}{STATUS_SUFFIX}"
    with ConsoleLines(sys.stdout) as console:
        recording = Recording(files, output, path, console.say)
        if addresses == (None, None):
            is_whole = recording.run(stop)
        else:
            is_whole = record_and_serve(recording, files, addresses, stop, console.say, qr=sys.stdout.isatty())
    if not is_whole:
        raise typer.Exit(EXIT_WITH_LOSSES)


def _address(option: str, given: str | None, default: str | int | None) -> "PageAddress | None":
    from groundsbot.calib.web import parse_page_address

    text = given if given is not None else default
    try:
        return None if text is None else parse_page_address(str(text))
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint=option) from error


@app.command()
def check(
    robot: RobotOption,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for recordings.")] = Path(),
    picture: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Picture to save, with the tags found; of several cameras each has its name behind FILE's.  "
            "[default: check.jpg beside robot.yaml]",
        ),
    ] = None,
    listen_s: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.1, help="Time for which to listen to wheels and gyro.")
    ] = 2.0,
    push: Annotated[
        bool,
        typer.Option("--push", help="Then ask to push the robot by hand: 1 m ahead, then one full turn to the left."),
    ] = False,
    page: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:]PORT",
            help="Serve a page with results and pictures, which can repeat the check; with a port alone, on this "
            "computer only.",
        ),
    ] = None,
) -> None:
    """Check every device before driving: port and line rate, camera and calibration, tags in view, clock, disk space.

    For a gyro it prints sample rate, bias and noise while the robot stands, and compares its turn with that of the
    wheels: with --listen-s 10, let the robot stand for some seconds, then turn it on the spot by 90 degrees, wheels on
    the floor.

    --push measures what only a known motion can show: which encoder is on which side, the sign of its counts, ticks per
    turn, and track. It prints how to push the robot, and what to change in robot.yaml.

    --page 0.0.0.0:8080 shows all of it on a phone, with the cameras' pictures. Its button checks again, with robot.yaml
    as it is then, until Ctrl-C.

    Exit code 1: a check failed; with --page 130, as Ctrl-C ends it.
    """
    import sys

    from groundsbot.onboard.monitoring import DeviceCheck, ShowPicture, check_push, check_robot
    from groundsbot.onboard.recorder import RobotFiles

    def checks(files: RobotFiles, say: Callable[[str], None], show: ShowPicture) -> Iterator[DeviceCheck]:
        yield from check_robot(files, output, picture or robot.with_name("check.jpg"), listen_s, show)
        if push:
            yield from check_push(files, say)

    def report(result: DeviceCheck) -> None:
        echo(f"{'ok  ' if result.passed else 'FAIL'} {result.name}: {result.text}")

    address = _address("--page", page, None)
    if address is not None:
        from groundsbot.onboard.page import serve_check

        serve_check(address, robot, checks, report, echo, qr=sys.stdout.isatty())
    has_passed = True
    for result in checks(RobotFiles(robot), echo, lambda *_: None):
        report(result)
        has_passed &= result.passed
    if not has_passed:
        raise typer.Exit(EXIT_REFUSED)


@app.command()
def capture(
    robot: RobotOption,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the pictures; may hold earlier ones.")
    ],
    name: Annotated[
        str | None,
        typer.Option("--camera", metavar="NAME", help="Name of the camera in robot.yaml, for a robot with several."),
    ] = None,
    board: Annotated[
        str, typer.Option(help="Specification of the board, as `groundsbot-calib camera --board` takes it.")
    ] = DEFAULT_BOARD.specification,
    views: Annotated[int, typer.Option(help="Number of pictures.")] = DEFAULT_VIEWS,
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Size of the pictures in px.  [default: the calibration's, else 1280x720]"),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Preview to save each second.  [default: capture.jpg beside robot.yaml]"),
    ] = None,
    page: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:]PORT",
            help="Serve a page with picture and instructions; with a port alone, on this computer only.",
        ),
    ] = None,
) -> None:
    """Take pictures of the calibration board for `groundsbot-calib camera`, with instructions how to hold it.

    A picture is taken when the board is still and the view differs from earlier ones. The command ends when there are
    enough pictures and no view is missing, or with Ctrl-C; pictures taken are kept. robot.yaml needs no calibration.

    Exit code 3: it was stopped before there were enough pictures; 1: there are none.
    """
    import contextlib
    import sys

    from rich.console import Console

    from groundsbot.calib.board import parse_board
    from groundsbot.onboard.camera import camera_for
    from groundsbot.onboard.capture import Capture, CaptureGuide, CaptureView, summary
    from groundsbot.onboard.page import serve_capture
    from groundsbot.onboard.process import RunClock, stop_event
    from groundsbot.onboard.recorder import capture_settings

    guide = CaptureGuide(parse_board(board), views)
    clock = RunClock()
    camera = camera_for(capture_settings(robot, name, size), clock, since_ns=clock.now_ns())
    view = CaptureView(Console())
    looked_at = picture or robot.with_name("capture.jpg")
    stop = stop_event()
    address = _address("--page", page, None)
    with contextlib.ExitStack() as stack:
        served = None
        if address is not None:
            served = stack.enter_context(serve_capture(address, robot, stop, view.say, qr=sys.stdout.isatty()))
        watch = served.show if served is not None else None
        taking = Capture(camera, clock, guide, output, looked_at, view.show, view.say, watch)
        try:
            with view.live():
                taking.run(stop)
        finally:
            lines = summary(guide, output)
            for line in lines:
                view.say(line)
            if served is not None:
                served.finish(lines)
    if not guide.enough:
        raise typer.Exit(EXIT_WITH_LOSSES if guide.kept else EXIT_REFUSED)


@app.command()
def status(
    place: Annotated[
        Path, typer.Argument(metavar="[DIR]", help="The output DIR of `record`, or its status file.")
    ] = Path(),
    once: Annotated[bool, typer.Option("--once", help="Print the status once, in plain lines, and exit.")] = False,
) -> None:
    """Show the status of a running recorder: rates, ages, losses, tags in view, hours left on the disk.

    What is wrong now (a silent device, losses in the last 10 s, a full disk) stands apart from what was lost so far.
    Without DIR, or with the service's output folder, the status of the service in /run/groundsbot is found.

    Exit code with --once: 0: recording, and nothing is wrong now; 1: no recorder is running; 3: something is wrong now.
    """
    from rich.console import Console

    from groundsbot.onboard.monitoring import is_alive, print_once, show_live

    console = Console()
    if not once and console.is_terminal:
        show_live(place, console)
    shown = print_once(place, console)
    if not is_alive(shown):
        raise typer.Exit(EXIT_REFUSED)
    if shown.problems:
        raise typer.Exit(EXIT_WITH_LOSSES)


def main() -> None:
    """Run the program."""
    run(app)


if __name__ == "__main__":
    main()
