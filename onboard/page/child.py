"""The page's process: servers for browsers and viewers, which take from the recorder what comes.

It has a low priority, may write no file, and opens few connections, so that whoever talks to it takes nothing from the
recording.
"""

import asyncio
import logging
import os
import resource
import socket
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Final

from groundsbot.calib.web import PageAddress
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.page.messages import Answer, PageSettings, ToPage
from groundsbot.onboard.process import settle_child

if TYPE_CHECKING:
    from groundsbot.onboard.page.hub import Hub

_NICE: Final = 15  # below detection, which has 0
_MOST_FILES: Final = 256
_BATTERY_PAUSE_S: Final = 10.0
_VIEWER_PAUSE_S: Final = 5.0


def serve_page(connection: Connection, listener: socket.socket | None, settings: PageSettings) -> None:
    """Serve until the recorder is gone.

    Args:
        connection: to the recorder.
        listener: the listening socket of the page; None: there are only viewers.
        settings: settings of the page.
    """
    settle_child(_NICE)
    with suppress(OSError):  # when memory runs out, this process goes first
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    # A line for each bad request would fill the recorder's journal.
    logging.disable(logging.CRITICAL)
    os.environ["FOXGLOVE_LOG_LEVEL"] = "off"
    import cv2

    cv2.setNumThreads(1)
    asyncio.run(_serve(connection, listener, settings))


async def _serve(connection: Connection, listener: socket.socket | None, settings: PageSettings) -> None:
    from groundsbot.onboard.page.hub import Hub

    hub = Hub(connection)
    if settings.viewer is not None:
        threading.Thread(target=_serve_viewers, args=(hub, settings.viewer, settings), daemon=True).start()
    for kind, limit in ((resource.RLIMIT_FSIZE, 0), (resource.RLIMIT_NOFILE, _MOST_FILES)):
        resource.setrlimit(kind, (limit, limit))
    arguments = (connection, hub, settings, asyncio.get_running_loop())
    threading.Thread(target=_take_from_recorder, args=arguments, daemon=True).start()
    if listener is None or settings.access is None:
        await asyncio.Event().wait()
    else:
        threading.Thread(target=_watch_batteries, args=(hub,), daemon=True).start()
        from groundsbot.calib.web import PageServer
        from groundsbot.onboard.page.app import make_app

        await PageServer(make_app(hub, settings.robot_id, settings.access)).serve([listener])


def _watch_batteries(hub: "Hub") -> None:
    """Look at the batteries again and again, here as a gauge may not answer for long."""
    from groundsbot.onboard.monitoring import battery_rows, read_batteries

    while True:
        hub.battery_rows = tuple(battery_rows(read_batteries()))
        time.sleep(_BATTERY_PAUSE_S)


def _serve_viewers(hub: "Hub", address: PageAddress, settings: PageSettings) -> None:
    """Serve viewers as soon as the address is free; the page does not wait for it."""
    from groundsbot.onboard.page.viewer import Viewer

    was_reported = False
    while True:
        try:
            hub.set_viewer(Viewer(address, settings.robot_id, settings.cameras, hub.report_topics))
        except RuntimeError as error:
            if not was_reported:
                hub.report_notice(f"foxglove {address}: cannot be served there ({error}); it is tried again")
            was_reported = True
            time.sleep(_VIEWER_PAUSE_S)
        else:
            return


def _take_from_recorder(
    connection: Connection, hub: "Hub", settings: PageSettings, loop: asyncio.AbstractEventLoop
) -> None:
    """Pass on what comes; without a recorder the process ends at once."""
    from groundsbot.onboard.page.preview import Preview, SideBySide, make_preview

    shown = SideBySide(settings.cameras)
    hub.report_watchers()  # it serves now
    with suppress(EOFError, OSError):
        while True:
            message: ToPage | Answer = connection.recv()
            if isinstance(message, Answer):
                loop.call_soon_threadsafe(hub.take_answer, message)
                continue
            hub.publish(message.head, message.messages)
            for camera, picture in message.pictures.items():
                with suppress(OnboardError):  # detection has reported a picture that cannot be decoded
                    preview = picture if isinstance(picture, Preview) else make_preview(*picture, settings.side_px_m)
                    shown.add(camera, preview)
                    hub.publish_preview(preview, camera)
            loop.call_soon_threadsafe(hub.take, message, shown.take())
    os._exit(0)
