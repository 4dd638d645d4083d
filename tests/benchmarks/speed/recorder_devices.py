"""The devices and clients of a recorder under load: wheel lines, pictures, pages and viewers, each in a process."""

import http.client
import json
import re
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from groundsbot.fixtures.recording.devices import PictureFolder, PtyPort, at_rate, gyro_line, wheel_line
from tests.support.tag_pictures import draw_tag

START_S: Final = 5.0
_PICTURES: Final = 12  # different ones
_TAGS: Final = 6
BATCH: Final = 20  # samples of the gyro in a line
_NOISE: Final = 2.0  # sigma of the sensor, grey levels
_QUALITY: Final = 85


@dataclass(frozen=True)
class Load:
    """What the devices give."""

    seconds: float
    lines_hz: float = 1000.0
    fps: float = 30.0
    width_px: int = 1280
    height_px: int = 720
    detector: str = "pupil-apriltags"
    keep: bool = True
    cameras: int = 1
    gyro: bool = False
    page_clients: int | None = None  # None: no page is served
    viewer: bool = False


def pictures(load: Load) -> list[bytes]:
    """JPEG files of six tags on a textured wall, a little further along in each."""
    rng = np.random.default_rng(1)
    width, height = load.width_px, load.height_px
    side = height / 5
    texture = cv2.resize(rng.normal(0.0, 12.0, (height // 8, width // 8)), (width, height))
    made = []
    for step in range(_PICTURES):
        grey = 150.0 + texture
        for tag in range(_TAGS):
            x, y = width * (0.5 + tag % 3) / 3 - side / 2 + 3.3 * step, height * (0.5 + tag // 3) / 2 - side / 2
            patch = round(1.5 * side)
            corners = np.array([[0.25, 0.25], [1.25, 0.3], [1.2, 1.3], [0.3, 1.25]]) * side * 0.95
            left, top = round(x - 0.25 * side), round(y - 0.25 * side)
            drawn = draw_tag("tag36h11", tag, corners, (patch, patch))
            grey[top : top + patch, left : left + patch] = drawn[: height - top, : width - left]
        noisy = np.clip(grey + rng.normal(0.0, _NOISE, grey.shape), 0, 255).astype(np.uint8)
        made.append(cv2.imencode(".jpg", np.dstack([noisy] * 3), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())
    return made


def speak(load: Load, folder: Path, go: Any, measured: Any, over: Any) -> None:
    port = PtyPort(folder / "wheels", patient=True)  # held up itself, it would send more at once than a wire can
    times: list[int] = []

    def act(index: int) -> None:
        now_ns = time.monotonic_ns()
        port.send(wheel_line(index, now_ns))
        if load.gyro and index % BATCH == 0:
            since_us = (now_ns - (times[-BATCH] if index else now_ns - 20_000_000)) // 1000
            port.send(gyro_line(index // BATCH, now_ns, BATCH, min(since_us // BATCH, 5_000)))
        times.append(now_ns)

    go.wait()
    at_rate(load.lines_hz, load.seconds, act)
    measured.put((times, port.refused))
    over.wait()  # a port that goes before the recording ends is a loss


def show_pictures(load: Load, folder: Path, go: Any, shown: Any, over: Any) -> None:
    ready = pictures(load)
    cameras = [PictureFolder(folder / f"pictures{each}", keep=60) for each in range(load.cameras)]
    go.wait()
    n_shown = [0] * load.cameras

    def act(index: int) -> None:
        camera = index % load.cameras  # in turn, as cameras that are not in step
        cameras[camera].show(ready[index // load.cameras % len(ready)])
        n_shown[camera] += 1

    at_rate(load.fps * load.cameras, load.seconds, act)
    shown.put(n_shown)
    over.wait()


def watch_page(url: str, clients: int, watched: Any, over: Any) -> None:
    counts = [0] * clients
    port, token = int(re.findall(r":(\d+)/", url)[0]), url.partition("token=")[2]
    headers = {"Cookie": f"groundsbot_load={token}"}

    def client(index: int) -> None:
        states, asking = (http.client.HTTPConnection("127.0.0.1", port, timeout=30.0) for _ in range(2))
        states.request("GET", "/states", headers=headers)
        lines, shown = states.getresponse(), 0
        while (line := lines.readline()) and not over.is_set():
            if line.startswith(b"data: ") and (newest := json.loads(line[6:])["picture"]) != shown:
                shown = newest
                asking.request("GET", "/picture", headers=headers)
                counts[index] += len(asking.getresponse().read()) > 0

    for index in range(clients):
        threading.Thread(target=client, args=(index,), daemon=True).start()
    over.wait()
    watched.put(counts)


def view_topics(url: str, _clients: int, viewed: Any, over: Any) -> None:
    """Takes all topics, and counts the bytes of the messages."""
    n_bytes = 0
    time.sleep(START_S / 2.0)  # until it is served
    with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None) as viewer:
        channels: list[dict[str, Any]] = []
        while not channels:
            channels = json.loads(viewer.recv()).get("channels", [])
        wanted = [{"id": each["id"], "channelId": each["id"]} for each in channels]
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        while not over.is_set():
            with suppress(TimeoutError, ConnectionClosed):
                n_bytes += len(viewer.recv(timeout=0.5))
    viewed.put(n_bytes)
