"""The page of a capture of pictures for the camera's calibration: how to hold the board, and what is there already."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final

from groundsbot.calib.web import PageAddress, open_page
from groundsbot.onboard.capture import Advice, CaptureGuide
from groundsbot.onboard.log import Picture
from groundsbot.onboard.page.link import PageLink
from groundsbot.onboard.page.messages import TOKEN_NAME, PageSettings, PageState
from groundsbot.onboard.page.preview import make_board_preview

_LAST_S: Final = 5.0  # for browsers to show the last state


class CapturePage:
    """The page of a capture."""

    def __init__(self, link: PageLink) -> None:
        self._link = link

    def show(self, picture: Picture, advice: Advice, guide: CaptureGuide) -> None:
        """Show a picture, and the advice for it."""
        rating = "good" if advice.keep else "" if advice.seen is not None else "warn"
        rows = [
            ("now", advice.text, rating),
            ("pictures", f"{guide.kept} of {guide.wanted}", ""),
            *(("missing", each, "") for each in guide.missing),
            ("board", guide.board.specification, ""),
        ]
        self._link.offer_state(PageState("capturing", tuple(rows)))
        if self._link.wants_picture():
            self._link.offer_preview(make_board_preview(picture, advice.seen, guide.spread))

    def finish(self, lines: Sequence[str]) -> None:
        """Show what came of it, and give browsers time to take it."""
        self._link.offer_state(PageState("done", tuple(("result", each, "") for each in lines)))
        self._link.wait_for_watchers(_LAST_S)


@contextmanager
def serve_capture(
    address: PageAddress, robot: Path, stop: threading.Event, say: Callable[[str], None], *, qr: bool
) -> Iterator[CapturePage]:
    """Serve the page of a capture during the block.

    Args:
        address: where.
        robot: robot.yaml; its folder keeps the page's token.
        stop: ends the capture; set by the page's button.
        say: called with each line for the console.
        qr: whether to show a QR code of the page's URL.

    Raises:
        CalibError: the address cannot be served.
    """
    endpoint = open_page(address, robot.with_name(TOKEN_NAME), "robot", say, qr=qr)

    def execute(act: str) -> str:
        if act != "stop":
            return "pictures are being taken for the calibration"
        stop.set()
        return ""

    settings = PageSettings("capture", endpoint.access("capture"), None, None)
    with closing(PageLink(endpoint, settings, lambda command: execute(command.act), say)) as link:
        yield CapturePage(link)
