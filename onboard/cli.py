"""groundsbot-onboard: what runs on the robot's computer."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.command_line import EXIT_REFUSED, EXIT_WITH_LOSSES, new_app, run

if TYPE_CHECKING:
    from onboard.messages import Event

app = new_app("Record a drive of a robot: wheels, camera and the tags it sees, on one clock.")

RobotOption = Annotated[Path, typer.Option("--robot", metavar="FILE", help="The robot's robot.yaml.")]


@app.command()
def record(
    robot: RobotOption,
    output: Annotated[Path, typer.Option(metavar="DIR", help="Where run folders go; may exist.")],
) -> None:
    """Record one run until stopped (Ctrl-C or SIGTERM).

    Writes DIR/RUN_ID/0000.core.mcap, and 0000.camera.mcap where pictures are kept. Devices that are absent are waited
    for. A folder as the camera gives the pictures that appear in it as T.png or T.jpg, T being the middle of the
    exposure in ns of the host's wall clock (CLOCK_REALTIME); relative paths start at robot.yaml.

    Exit code 0: nothing was lost; 3: something was, said in words and in the log.
    """
    import signal
    import threading

    from onboard.live_recorder import LiveRecorder
    from onboard.robot_files import RobotFiles

    stop = threading.Event()
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda *_: stop.set())
    recorder = LiveRecorder(RobotFiles(robot), output, stop, _tell_event, typer.echo)
    recorder.run()
    core = recorder.core
    counts = ", ".join(f"{count} {topic}" for topic, count in sorted(core.counts.items()))
    typer.echo(f"{core.folder}: {counts}")
    if core.losses:
        lost = ", ".join(f"{count} {what}" for what, count in sorted(core.losses.items()))
        typer.echo(f"lost: {lost}")
        raise typer.Exit(EXIT_WITH_LOSSES)


@app.command()
def check(
    robot: RobotOption,
    output: Annotated[Path, typer.Option(metavar="DIR", help="Where recordings will go.")] = Path(),
) -> None:
    """Check every device before driving; exit code 1 if one fails."""
    from onboard.check import check_robot
    from onboard.robot_files import RobotFiles

    failed = False
    for result in check_robot(RobotFiles(robot), output):
        typer.echo(f"{'ok  ' if result.passed else 'FAIL'} {result.name}: {result.text}")
        failed = failed or not result.passed
    if failed:
        raise typer.Exit(EXIT_REFUSED)


def _tell_event(event: "Event") -> None:
    typer.echo(f"{event.kind}: {event.text}")


def main() -> None:
    """The program's entry."""
    run(app)


if __name__ == "__main__":
    main()
