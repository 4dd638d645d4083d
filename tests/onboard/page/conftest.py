"""A recording under way with its page, and a client for it."""

import http.client
import json
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest

from groundsbot.fixtures.recording.devices import PictureFolder, pace
from groundsbot.onboard.log.messages import Event
from groundsbot.onboard.log.reading.reader import find_logs, read_log
from tests.support.devices.live_recording import PATIENCE_S, PATIENT, Driver, robot_yaml, tag_jpeg, until
from tests.support.hostile.page_attacks import Site, free_port
from tests.support.programs import running


@dataclass
class Served:
    """A recorder's process with a page, on simulated devices."""

    process: "subprocess.Popen[str]"
    url: str
    logs: Path
    said: list[str] = field(default_factory=list)

    @property
    def site(self) -> Site:
        return Site(self.url, "groundsbot_gb1", ("/", "/picture", "/states"), "/picture", "'sha256-", True)

    def ask(
        self, path: str, method: str = "GET", body: bytes | None = None, token: str | None = None, **headers: str
    ) -> tuple[int, bytes]:
        """Status and body of a request with the token; a header's name has _ for -."""
        return self.site.ask(path, method, body, token, **headers)

    def order(self, command: str, text: str = "", **headers: str) -> tuple[int, dict[str, str]]:
        """Has the page carry out a command, as its own script does."""
        body = json.dumps({"command": command, "text": text}).encode()
        own = {"Content_Type": "application/json", "Origin": f"http://127.0.0.1:{self.site.port}"} | headers
        status, answer = self.ask("/command", "POST", body, **own)
        return status, json.loads(answer)

    def state(self) -> dict[str, Any]:
        """The first state that a browser gets."""
        with self.watching() as states:
            return next(states)

    @contextmanager
    def watching(self) -> Iterator[Iterator[dict[str, Any]]]:
        """States as a browser gets them."""
        asking = http.client.HTTPConnection("127.0.0.1", self.site.port, timeout=PATIENCE_S)
        try:
            asking.request("GET", "/states", headers={"Cookie": f"groundsbot_gb1={self.site.token}"})
            answer = asking.getresponse()
            assert answer.status == 200, answer.read()
            yield (json.loads(line[6:]) for line in iter(answer.readline, b"") if line.startswith(b"data: "))
        finally:
            asking.close()

    def wait_for_state(self, true: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        with self.watching() as states:
            return next(state for state in states if true(state))

    def end(self) -> str:
        """Tells the recorder to end, and returns what it said."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(PATIENCE_S)
        until(lambda: not self.reader.is_alive(), "the end of the output")
        return "".join(self.said)

    def __post_init__(self) -> None:
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.said.extend(iter(self.process.stdout.readline, ""))

    def events(self) -> list[Event]:
        return [
            each.message
            for log in sorted(find_logs([self.logs]))
            for each in read_log(log, ["/events"])
            if isinstance(each.message, Event)
        ]


def page_processes(recorder: int) -> list[int]:
    """Processes below the recorder that serve a page: the ones with the lowest priority."""
    found = []
    for task in Path(f"/proc/{recorder}/task").iterdir():
        for child in (task / "children").read_text().split():
            if int(Path(f"/proc/{child}/stat").read_text().rpartition(") ")[2].split()[16]) == 15:
                found.append(int(child))
    return found


@contextmanager
def serving(folder: Path, picture: bytes, recorder: str = "{picture_rate_hz: 5}") -> Iterator[tuple[Served, Driver]]:
    """Records with a page while the block runs: 100 lines and 15 pictures a second."""
    camera, enough = PictureFolder(folder / "pictures", keep=30), threading.Event()
    robot = robot_yaml(folder, f"{{encoder_port: {folder / 'wheels'}, camera: pictures}}", recorder)

    def show() -> None:
        for _ in takewhile(lambda _: not enough.is_set(), pace(15.0)):
            camera.show(picture)

    shower = threading.Thread(target=show, daemon=True)
    command = [sys.executable, "-c", f"{PATIENT}\nfrom groundsbot.onboard.cli import main\nmain()", "record"]
    arguments = ["--robot", robot, "--output", folder / "logs", "--page", free_port()]
    with Driver(folder / "wheels") as driver, running([*command, *arguments]) as process:
        driver.plug_in()
        assert process.stdout is not None
        heard = ""
        while "port_connected" not in heard or "camera_connected" not in heard:
            line = process.stdout.readline()
            assert line, heard
            heard += line
        shower.start()
        try:
            yield Served(process, re.findall(r"page: (\S+)", heard)[0], folder / "logs"), driver
        finally:
            enough.set()
            shower.join()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A recording under way; its state is left as it was found."""
    with serving(tmp_path_factory.mktemp("page"), tag_jpeg()) as (made, _):
        made.wait_for_state(lambda state: state["picture"] > 0)
        yield made
