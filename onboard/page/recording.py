"""Recording with a page, from which runs are started and stopped, and with viewers."""

import ipaddress
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Final, NamedTuple

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.web import PageAddress, listen_at, open_page, own_hosts, require_libraries
from groundsbot.onboard.monitoring import Recording
from groundsbot.onboard.page.link import PageLink
from groundsbot.onboard.page.messages import TOKEN_NAME, Command, PageSettings
from groundsbot.onboard.page.runs import RunControl
from groundsbot.onboard.recorder import RobotFiles

_VIEWER_LIBRARIES: Final = ("foxglove",)
_IDLE_S: Final = 1.0  # between two notifications of systemd


class Addresses(NamedTuple):
    """Where a recording is served; None: nowhere."""

    page: PageAddress | None
    viewer: PageAddress | None  # for Foxglove and Lichtblick


def record_and_serve(
    recording: Recording,
    files: RobotFiles,
    addresses: Addresses,
    stop: threading.Event,
    say: Callable[[str], None],
    *,
    qr: bool,
) -> bool:
    """Record until `stop` is set, and return whether nothing was lost.

    With a page it is one run after another, else a single one.

    Args:
        recording: records a run.
        files: the robot.
        addresses: where the recording is served.
        stop: ends the program.
        say: called with each line for the console.
        qr: whether to show a QR code of the page's URL.

    Raises:
        GroundsbotError: an address cannot be served, or the first run cannot start or continue.
    """
    endpoint = None
    if addresses.page is not None:
        endpoint = open_page(addresses.page, recording.output / TOKEN_NAME, "robot", say, qr=qr)
    settings = PageSettings(
        files.robot.robot_id,
        endpoint.access(files.robot.robot_id) if endpoint is not None else None,
        side_px_m(files),
        addresses.viewer,
        files.robot.camera_names,
    )
    if addresses.viewer is not None:
        _check_viewer(addresses.viewer, say)
    if endpoint is None:
        with closing(PageLink(None, settings, lambda _: "there is no page", say)) as link:
            return recording.run(stop, link, link.offer_status)
    control = RunControl(stop)
    with closing(PageLink(endpoint, settings, lambda command: _execute(command, control, recording), say)) as link:
        lossless, is_first = True, True
        while (run_stop := control.next_run(_IDLE_S, recording.stay_alive)) is not None:
            try:
                lossless &= recording.run(run_stop, link, link.offer_status, lambda: control.goes_on)
            except GroundsbotError as error:
                if is_first:
                    raise
                lossless = False
                link.report_trouble(str(error))
                say(f"no run: {error}")
            is_first = False
    return lossless


def _check_viewer(address: PageAddress, say: Callable[[str], None]) -> None:
    """Say where viewers are served, or why they cannot be."""
    require_libraries(f"foxglove {address}", _VIEWER_LIBRARIES, "foxglove")
    with closing(listen_at(address, "foxglove")) as listener:  # the server of the other process takes it
        is_everywhere = ipaddress.ip_address(listener.getsockname()[0]).is_unspecified
    for host in own_hosts() if is_everywhere else [address.host]:
        say(f"foxglove: ws://{PageAddress(host, address.port)}")


def _execute(command: Command, control: RunControl, recording: Recording) -> str:
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


def side_px_m(files: RobotFiles) -> float | None:
    """Return the focal length times the side of the robot's smallest tags, or None if one is not known."""
    sizes_m = [
        size_m
        for batch in files.robot.tags
        for size_m in (batch.default_size_m, *batch.sizes_m.values())
        if size_m is not None
    ]
    return min(each.model.fx_px for each in files.cameras) * min(sizes_m) if files.cameras and sizes_m else None
