"""Recording with the page: runs one after another, started and stopped from it."""

import importlib.util
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Final

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.robot import PageAddress
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.monitoring import Recording
from groundsbot.onboard.page.address import Door, open_door, qr_lines
from groundsbot.onboard.page.link import PageLink
from groundsbot.onboard.page.messages import Command, PageSettings
from groundsbot.onboard.page.runs import RunControl
from groundsbot.onboard.recorder import RobotFiles

_LIBRARIES: Final = ("segno", "starlette", "uvicorn")
_IDLE_S: Final = 1.0  # between two notifications of systemd


def record_with_page(
    recording: Recording,
    files: RobotFiles,
    address: PageAddress,
    stop: threading.Event,
    say: Callable[[str], None],
    *,
    qr: bool,
) -> bool:
    """Record runs until `stop` is set, and return whether nothing was lost in any of them.

    Args:
        recording: records a run.
        files: the robot.
        address: where the page is served.
        stop: ends the program.
        say: called with each line for the console.
        qr: whether to show a QR code of the page's URL.

    Raises:
        GroundsbotError: the page cannot be served, or the first run cannot start or continue.
    """
    missing = [each for each in _LIBRARIES if importlib.util.find_spec(each) is None]
    if missing:
        raise OnboardError(
            f"page {address}: {missing[0]} is not installed; pip install 'groundsbot[robot]', or record without a page"
        )
    door = open_door(address, recording.output)
    for line in _invitation(door, qr):
        say(line)
    control = RunControl(stop)
    settings = PageSettings(files.robot.robot_id, door.token, address.host, door.is_local, _side_px_m(files))
    link = PageLink(door, settings, lambda command: _obey(command, control, recording), say)
    lossless, is_first = True, True
    with closing(link):
        while (run_stop := control.next_run(_IDLE_S, recording.stay_alive)) is not None:
            try:
                lossless &= recording.run(run_stop, link.offer_picture, link.offer_status, lambda: control.goes_on)
            except GroundsbotError as error:
                if is_first:
                    raise
                link.report_trouble(str(error))
                say(f"no run: {error}")
            is_first = False
    return lossless


def _obey(command: Command, control: RunControl, recording: Recording) -> str:
    """Carry out a command, and return why it is refused, or an empty text."""
    match command.act:
        case "start":
            return "" if control.start() else "a run is being recorded"
        case "stop":
            return "" if control.stop() else "no run is being recorded"
        case "note":
            recorder = recording.recorder
            if recorder is None or not recorder.begun.is_set() or recorder.is_stopping:
                return "no run is being recorded, so there is no log for the note"
            recorder.note(command.text)
            return ""


def _invitation(door: Door, qr: bool) -> Iterator[str]:
    urls = door.urls()
    if qr and not door.is_local:
        yield from qr_lines(urls[0])
    for url in urls:
        yield f"page: {url}"


def _side_px_m(files: RobotFiles) -> float | None:
    """Return the focal length times the side of the robot's smallest tags, or None if one is not known."""
    sizes_m = [
        size_m
        for batch in files.robot.tags
        for size_m in (batch.default_size_m, *batch.sizes_m.values())
        if size_m is not None
    ]
    return files.camera.fx_px * min(sizes_m) if files.camera is not None and sizes_m else None
