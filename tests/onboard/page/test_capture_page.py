"""The page while pictures for the camera's calibration are taken, in a browser."""

import re
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.fixtures.recording.devices import PictureFolder, pace
from tests.onboard.capture.test_capture_command import program
from tests.support.board_views import render_views
from tests.support.browser import Page
from tests.support.devices.live_recording import PATIENCE_S
from tests.support.hostile.page_attacks import free_port

RED_AND_GREEN = """(() => {
  const picture = document.getElementById('picture'), canvas = document.createElement('canvas');
  canvas.width = picture.naturalWidth, canvas.height = picture.naturalHeight;
  if (!canvas.width) return [0, 0];
  const context = canvas.getContext('2d');
  context.drawImage(picture, 0, 0);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height).data;
  let red = 0, green = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    red += pixels[i] > pixels[i + 1] + 80;
    green += pixels[i + 1] > pixels[i] + 80;
  }
  return [red, green];
})()"""


EMPTY = np.full((480, 640), 120, np.uint8)


def row(label: str) -> str:
    labels = "[...document.querySelectorAll('dt')]"
    return f"{labels}.find((each) => each.textContent === '{label}')?.nextSibling.textContent"


@contextmanager
def holding_up(folder: Path) -> Iterator[list[NDArray[np.uint8]]]:
    """Shows each of the pictures in a list for 2 s, again and again; at first there is no board."""
    camera, enough = PictureFolder(folder, keep=20), threading.Event()
    pictures = [EMPTY]

    def show() -> None:
        for number, _ in enumerate(takewhile(lambda _: not enough.is_set(), pace(10.0))):
            picture = pictures[number // 20 % len(pictures)]
            camera.show(cv2.imencode(".jpg", picture)[1].tobytes())

    shower = threading.Thread(target=show, daemon=True)
    shower.start()
    try:
        yield pictures
    finally:
        enough.set()
        shower.join()


@contextmanager
def opened(window: Page, folder: Path, wide: int) -> Iterator["subprocess.Popen[str]"]:
    """A capture whose page is open."""
    with program(folder, "--views", "8", "--page", str(free_port())) as process:
        assert process.stdout is not None
        url = next(found[1] for line in process.stdout if (found := re.match(r"page: (\S+)", line)))
        window.visit(url, wide=wide, high=844, mobile=wide < 600)
        window.wait_for(f"{row('now')}?.startsWith('no board 7x9-25mm-18mm-5x5_100 in view')")
        assert window.look("getComputedStyle(document.getElementById('note')).display") == "none"
        yield process
        window.wait_for("document.getElementById('state').textContent === 'done'")
        assert window.look("document.getElementById('lost').hidden")
        process.communicate(timeout=PATIENCE_S)
    assert not list((folder / "pictures").glob(".*"))  # the page's token lies beside robot.yaml


def test_the_page_shows_when_it_is_enough(window: Page, tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number, picture in enumerate(render_views()[:-2], start=1):
        cv2.imwrite(str(pictures / f"{number:04}.jpg"), picture)
    with holding_up(tmp_path / "camera") as shown, opened(window, tmp_path, 390) as process:
        shown[:] = render_views()[-2:]
    assert process.returncode == 0
    assert window.look(row("result")) == f"{pictures}: 12 pictures"


def test_the_page_guides_and_stops_a_capture(window: Page, tmp_path: Path) -> None:
    with holding_up(tmp_path / "camera") as shown, opened(window, tmp_path, 1200) as process:
        shown[:] = render_views()[:1]
        window.wait_for(f"{row('pictures')} === '1 of 8' && {RED_AND_GREEN}.every((count) => count > 20)")
        assert window.look(row("missing")).startswith("show the board at the picture's")
        window.stop_run()
    assert process.returncode == 3
