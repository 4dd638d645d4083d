"""A robot whose controller and camera answer as real ones do, in real time, through a port and a folder.

It stands, has the board held up to its camera, or drives once through the room.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.camera.model import CameraModel
from groundsbot.fixtures.drives.calibration import true_tag_sizes_m
from groundsbot.fixtures.drives.wheel_controller import Controller
from groundsbot.fixtures.pictures.board_picture import BoardPainter, drawn_views
from groundsbot.fixtures.pictures.render import Renderer
from groundsbot.fixtures.pictures.textures import ByteArray
from groundsbot.fixtures.recording.devices import PictureFolder, PtyPort, wheel_line
from groundsbot.fixtures.recording.session import Options, Picture, Session, prepare
from groundsbot.fixtures.worlds.scene import tags_of
from groundsbot.fixtures.worlds.world import World, load_world
from tests.support.board_views import good_views
from tests.support.devices.live_recording import repeat

_NS_PER_S = 1_000_000_000
_WHEEL_RATE_HZ = 100.0
_PICTURE_RATE_HZ = 5.0
_BOARD_PERIOD_S = 0.05
_SPEED_M_S = 1.2
_SEED = 0


class SimulatedRobot:
    """One robot of the room, as its robot.yaml describes it but for what tape and ruler cannot measure.

    Attributes:
        camera: as it truly is.
    """

    def __init__(self, robot_yaml: dict[str, Any], port: Path, pictures: Path) -> None:
        """Drives it and takes all pictures, to be shown later.

        Args:
            robot_yaml: content of its file.
            port: link to its controller, made here.
            pictures: folder of its camera, made here.
        """
        self._session = _session(robot_yaml)
        assert self._session.camera is not None
        self.camera: CameraModel = self._session.camera
        self._link = port
        self._port = PtyPort(port)
        self._folder = PictureFolder(pictures, keep=50)
        self._lines = Controller(self._session.world.wheel_link, _SEED, self._session.nominal.robot_id).lines(
            self._session.drive, self._session.true.wheels
        )
        self._pictures = list(_render(self._session))
        self._board = _board_pictures(self.camera)

    @contextmanager
    def standing(self) -> Iterator[None]:
        """While the block runs; a tag is in view."""
        _, seen = self._pictures[len(self._pictures) // 2]
        with (
            repeat(lambda index: self._port.send(wheel_line(index, time.monotonic_ns())), _WHEEL_RATE_HZ),
            repeat(lambda _: self._folder.show(seen), _PICTURE_RATE_HZ),
        ):
            yield

    @contextmanager
    def shown_the_board(self, taken: Path) -> Iterator[None]:
        """While the block runs, one view after the other, each until a picture more is in the folder `taken`."""
        views = cycle(self._board)
        view, n_taken = next(views), 0

        def show(_: int) -> None:
            nonlocal view, n_taken
            before, n_taken = n_taken, len(list(taken.glob("0*")))
            if n_taken > before:
                view = next(views)
            self._folder.show(view)

        with repeat(show, 1.0 / _BOARD_PERIOD_S):
            yield

    def plug_in_again(self) -> None:
        """From now on its lines wait for a reader who is held up: it is not the machine's load that is tested."""
        self._port.unplug()
        self._port = PtyPort(self._link, patient=True)

    def unplug(self) -> None:
        """Unplug the device permanently."""
        self._port.unplug()

    def drive(self) -> None:
        """Drives once, in real time."""
        begin_ns, begin_s = time.time_ns(), time.monotonic()
        lines = ((line.arrival_ns, line.data, None) for line in self._lines)
        pictures = ((taken.arrival_ns, data, taken) for taken, data in self._pictures)
        for at_ns, data, taken in sorted([*lines, *pictures], key=lambda event: event[0]):
            time.sleep(max(0.0, begin_s + at_ns / _NS_PER_S - time.monotonic()))
            if taken is None:
                self._port.send(data)
            else:
                self._folder.show(data, stamp_ns=begin_ns + taken.middle_ns)


def _session(robot_yaml: dict[str, Any]) -> Session:
    room = load_world("room")
    model = room.robots[0]
    content = {name: value for name, value in robot_yaml.items() if name not in ("robot_id", "camera", "devices")}
    route = model.route.model_copy(update={"speed_m_s": _SPEED_M_S, "acceleration_m_s2": 1.5, "still_s": 0.5})
    robot = model.model_copy(update={"id": robot_yaml["robot_id"], "robot": content, "route": route})
    world: World = room.model_copy(update={"robots": [robot]})
    tags = tags_of(world.tags, true_tag_sizes_m(world, _SEED, False))
    return prepare(world, robot, tags, Options(_SEED, frame_rate_hz=_PICTURE_RATE_HZ))


def _render(session: Session) -> Iterator[tuple[Picture, bytes]]:
    eye, world, rng = session.eye, session.world, np.random.default_rng(_SEED)
    assert eye is not None
    renderer = Renderer(world.pictures, world.ceiling_height_m, session.tags, session.faces, eye)
    for taken in session.pictures():
        yield taken, _jpeg(renderer.picture(session.drive, taken.middle_ns, rng))


def _board_pictures(camera: CameraModel) -> list[bytes]:
    """What a person does who follows the advice: first everywhere, then here and there."""
    painter, rng = BoardPainter(camera, DEFAULT_BOARD), np.random.default_rng(_SEED)
    views = [*good_views(), *drawn_views(camera, DEFAULT_BOARD, 20, rng)]
    return [_jpeg(painter.picture(view, rng)) for view in views]


def _jpeg(picture: ByteArray) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
