"""A browser without a window, driven over a pipe by the DevTools protocol.

https://chromedevtools.github.io/devtools-protocol; messages end with a zero byte.
"""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PATIENCE_S = 120.0  # a busy machine is slow


def chromium() -> str | None:
    """The program, where there is one."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Page:
    """One open page, and what went wrong in it."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self._to, self._from = to_browser, from_browser
        self._unread = b""
        self._last = 0
        self._session: str | None = None
        self.complaints: list[str] = []
        self.requests: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Sends a command and waits for its result."""
        self._last += 1
        message = {"id": self._last, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._last:
                assert "error" not in answer, answer["error"]
                result: dict[str, Any] = answer["result"]
                return result

    def look(self, expression: str) -> Any:
        """What an expression is in the page."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Until it is true."""
        deadline = time.monotonic() + PATIENCE_S
        while not self.look(expression):
            assert time.monotonic() < deadline, f"never came true: {expression}"
            time.sleep(0.05)

    def stop_run(self) -> None:
        """Taps the button of a robot's page twice, at once: the second tap counts for some seconds only."""
        button = "document.getElementById('run')"
        text = f"{button}.textContent"
        self.wait_for(f"!{button}.disabled && ({button}.click(), {text} === 'Tap again to stop') && !{button}.click()")

    def open(self, path: Path, *, wide: int = 1200, high: int = 900, mobile: bool = False) -> None:
        """Opens a report and waits until all is drawn."""
        self.visit(path.as_uri(), wide=wide, high=high, mobile=mobile)
        self.wait_for("document.documentElement?.dataset.drawn === 'yes'")

    def visit(self, url: str, *, wide: int = 1200, high: int = 900, mobile: bool = False) -> None:
        """Opens an address."""
        self.call("Emulation.setDeviceMetricsOverride", width=wide, height=high, deviceScaleFactor=1, mobile=mobile)
        self.call("Page.navigate", url=url)

    def scheme(self, name: str) -> None:
        """Light or dark, as the person's system is set."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def point_at(self, x: float, y: float) -> None:
        """Moves the mouse there."""
        for step in (3.0, 0.0):
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + step, y=y + step)

    def turn_wheel(self, x: float, y: float, by: float) -> None:
        """Zooms."""
        self.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=by)

    def pdf(self) -> bytes:
        """As printed."""
        return base64.b64decode(self.call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69)["data"])

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._unread:
            ready, _, _ = select.select([self._from], [], [], PATIENCE_S)
            assert ready, "the browser says nothing"
            received = os.read(self._from, 1 << 16)
            assert received, "the browser has gone"
            self._unread += received
        line, self._unread = self._unread.split(b"\0", 1)
        message: dict[str, Any] = json.loads(line)
        self._note(message.get("method", ""), message.get("params", {}))
        return message

    def _note(self, method: str, told: dict[str, Any]) -> None:
        if method == "Runtime.exceptionThrown":
            self.complaints.append(str(told["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"):
            self.complaints.append(str(told["args"]))
        elif method == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.complaints.append(str(told["entry"]))
        elif method == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])


@contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """A page of a browser whose profile lies in a folder; the browser ends with the block."""
    program = chromium()
    assert program is not None
    browser_reads, to_browser = os.pipe()
    from_browser, browser_writes = os.pipe()
    # The protocol's pipe is at 3 and 4.
    command = (
        f'exec 3<&{browser_reads} 4>&{browser_writes}; exec "$0" --headless=new --no-sandbox --disable-gpu '
        '--no-first-run --disable-dev-shm-usage --remote-debugging-pipe --user-data-dir="$1"'
    )
    with subprocess.Popen(
        ["bash", "-c", command, program, str(folder)],
        pass_fds=(browser_reads, browser_writes),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        os.close(browser_reads)
        os.close(browser_writes)
        try:
            yield Page(to_browser, from_browser)
        finally:
            process.terminate()
            os.close(to_browser)
            os.close(from_browser)
