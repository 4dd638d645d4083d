"""The page of a check of the devices before a drive: each test with its verdict, and what the cameras see."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final, NoReturn

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.foundation import plural
from groundsbot.calib.web import Endpoint, PageAddress, open_page
from groundsbot.onboard.detection import Detection
from groundsbot.onboard.log import Picture
from groundsbot.onboard.monitoring import DeviceCheck, ShowPicture
from groundsbot.onboard.page.link import PageLink
from groundsbot.onboard.page.messages import TOKEN_NAME, Command, PageSettings, PageState
from groundsbot.onboard.page.preview import Preview, join_previews, make_preview
from groundsbot.onboard.page.recording import side_px_m
from groundsbot.onboard.recorder import RobotFiles

_LAST_S: Final = 5.0  # for browsers to show the last state
_UNDER_WAY: Final = "the devices are being checked"

Say = Callable[[str], None]
Checks = Callable[[RobotFiles, Say, ShowPicture], Iterator[DeviceCheck]]


class CheckPage:
    """The page of one check after another."""

    def __init__(self, endpoint: Endpoint, say: Say) -> None:
        """Serve the page, without results."""
        self._results: list[DeviceCheck] = []
        self._previews: dict[str, Preview | None] = {}
        self._side_px_m: float | None = None
        self._again = threading.Event()
        self._is_under_way = True
        settings = PageSettings("check", endpoint.access("check"), None, None)
        self._link = PageLink(endpoint, settings, self._execute, say)

    def begin(self, files: RobotFiles | None) -> None:
        """Begin a check of a robot; None: its files cannot be used."""
        self._results = []
        self._previews = dict.fromkeys(files.robot.camera_names) if files is not None else {}
        self._side_px_m = side_px_m(files) if files is not None else None
        self._is_under_way = True
        self._again.clear()
        self._show("checking", _UNDER_WAY, "")

    def prompt(self, text: str) -> None:
        """Show what a person is to do."""
        self._show("checking", text, "warn")

    def add(self, result: DeviceCheck) -> None:
        """Show a result."""
        self._results.append(result)
        self._show("checking", _UNDER_WAY, "")

    def show_picture(self, camera: str, picture: Picture, detections: Sequence[Detection]) -> None:
        """Show a camera's picture with the tags found in it."""
        self._previews[camera] = preview = make_preview(picture, detections, self._side_px_m)
        self._link.offer_preview(preview if len(self._previews) == 1 else join_previews(self._previews))

    def finish(self) -> None:
        """Show the verdict, and offer to check again."""
        self._is_under_way = False
        self._show("checked", *self._verdict())

    def wait_for_repeat(self) -> None:
        """Wait for the page's button."""
        self._again.wait()

    def close(self) -> None:
        """Show the last results as those of an ended program, and stop serving."""
        verdict = ("ended before all was checked", "bad") if self._is_under_way else self._verdict()
        self._show("done", *verdict)
        self._link.wait_for_watchers(_LAST_S)
        self._link.close()

    def _execute(self, command: Command) -> str:
        """Carry out a command, and return why it is refused, or an empty text; called from the link's thread."""
        if command.act != "start":
            return "only a check can be started here"
        if self._is_under_way:
            return "a check is under way"
        self._again.set()
        return ""

    def _verdict(self) -> tuple[str, str]:
        """Return what came of the check, and its rating."""
        failed = [each.name for each in self._results if not each.passed]
        if failed:
            return f"{plural(len(failed), 'check')} failed: {', '.join(failed)}", "bad"
        return "all checks passed", "good"

    def _show(self, name: str, text: str, rating: str) -> None:
        rows = [
            (each.name, f"ok: {each.text}", "good") if each.passed else (each.name, f"failed: {each.text}", "bad")
            for each in self._results
        ]
        has_pictures = any(each is not None for each in self._previews.values())
        self._link.offer_state(PageState(name, (("now", text, rating), *rows), has_pictures))


def serve_check(
    address: PageAddress, robot: Path, checks: Checks, report: Callable[[DeviceCheck], None], say: Say, *, qr: bool
) -> NoReturn:
    """Check the devices, and again for each touch of the page's button, until a signal ends the program.

    Args:
        address: where the page is served.
        robot: robot.yaml, which is read again for each check; its folder keeps the page's token.
        checks: yields the results; called with the robot, what prints a line, and what shows a picture.
        report: called with each result.
        say: called with each line for the console.
        qr: whether to show a QR code of the page's URL.

    Raises:
        GroundsbotError: the address cannot be served, or the robot's files cannot be used in the first check.
    """
    files: RobotFiles | None = RobotFiles(robot)
    trouble = ""
    endpoint = open_page(address, robot.with_name(TOKEN_NAME), "robot", say, qr=qr)
    with closing(CheckPage(endpoint, say)) as page:

        def prompt(text: str) -> None:
            say(text)
            page.prompt(text)

        while True:
            page.begin(files)
            unusable = [DeviceCheck("robot.yaml", False, trouble)]
            for result in unusable if files is None else checks(files, prompt, page.show_picture):
                report(result)
                page.add(result)
            page.finish()
            say("Checked; the page's button checks again, and Ctrl-C ends.")
            page.wait_for_repeat()
            try:
                files = RobotFiles(robot)
            except GroundsbotError as error:
                files, trouble = None, str(error)
