"""A recording under way, seen by a client of Foxglove's WebSocket protocol."""

import base64
import itertools
import json
import re
import signal
import socket
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from groundsbot.calib.errors import CalibError
from groundsbot.calib.web.endpoint import listen_at
from groundsbot.calib.web.page_address import PageAddress, parse_page_address
from groundsbot.fixtures.recording.devices import PictureFolder, pace
from groundsbot.onboard.log.messages import (
    PICTURE_TOPIC,
    TOPICS,
    CompressedImage,
    FrameTransform,
    RunInfo,
    TagDetections,
    WheelEncoders,
    camera_topic,
)
from groundsbot.onboard.log.picture import decode
from groundsbot.onboard.log.reading.reader import find_logs, read_log
from groundsbot.onboard.page.child import _serve_viewers
from groundsbot.onboard.page.messages import PageSettings
from groundsbot.onboard.page.viewer import MOST_VIEWERS, PREVIEW_TOPIC, Viewer, viewer_topics
from tests.onboard.page.conftest import Served, page_processes, serving
from tests.support.devices.live_recording import PATIENCE_S, robot_yaml, tag_jpeg, two_cameras_yaml, until
from tests.support.foxglove import Watching, panels_in
from tests.support.hostile.page_attacks import free_port
from tests.support.paths import ROOT
from tests.support.programs import running

pytest.importorskip("foxglove", reason="no foxglove-sdk: `make setup` installs it")
client = pytest.importorskip("websockets.sync.client", reason="no websockets: `make setup` installs it")


@contextmanager
def watching(port: int, cameras: Sequence[str] = ("",)) -> Iterator[Watching]:
    until(lambda: _is_served(port), "the server")
    with client.connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None) as connection:
        yield Watching(connection, viewer_topics(cameras))


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, int]]:
    """A recording under way, and the port of its viewers."""
    port = free_port()
    recorder = f"{{picture_rate_hz: 5, foxglove: {port}}}"
    with serving(tmp_path_factory.mktemp("viewer"), tag_jpeg(), recorder) as (served, _):
        served.wait_for_state(lambda state: state["picture"] > 0)
        yield served, port


def test_all_topics_have_the_schemas_of_the_log(viewer: tuple[Served, int]) -> None:
    with watching(viewer[1]) as watcher:
        for topic, channel in watcher.channels.items():
            assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
            kind = TOPICS[topic].schema if topic in TOPICS else CompressedImage
            assert channel["schemaName"] == kind.DESCRIPTOR.full_name
            described = FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
            names = {f"{file.package}.{each.name}" for file in described.file for each in file.message_type}
            assert kind.DESCRIPTOR.full_name in names


def test_messages_come_as_they_are_recorded(viewer: tuple[Served, int]) -> None:
    with watching(viewer[1]) as watcher:
        watcher.subscribe("/wheels", "/tags/detections", "/camera/image")
        first, second = (watcher.next_of("/wheels", WheelEncoders) for _ in range(2))
        assert second.sequence == first.sequence + 1
        detections = watcher.next_of("/tags/detections", TagDetections).detections
        assert [each.tag_id for each in detections] == [9]
        assert decode(watcher.next_of("/camera/image", CompressedImage).data).shape == (120, 160)
        watcher.subscribe(PREVIEW_TOPIC)
        assert decode(watcher.next_of(PREVIEW_TOPIC, CompressedImage).data).shape == (120, 160, 3)


def test_who_comes_later_gets_the_head_of_the_run(viewer: tuple[Served, int]) -> None:
    with watching(viewer[1]) as watcher:
        watcher.subscribe("/run")
        assert watcher.next_of("/run", RunInfo).robot_id == "gb1"


def test_what_is_seen_is_what_the_log_has(tmp_path: Path) -> None:
    port = free_port()
    with serving(tmp_path, tag_jpeg(), f"{{picture_rate_hz: 5, foxglove: {port}}}") as (served, _):
        with watching(port) as watcher:
            watcher.subscribe("/wheels")
            messages = watcher.messages()
            seen = {(time_ns, data) for _, time_ns, data in itertools.islice(messages, 50)}
        served.end()
    (log,) = find_logs([served.logs])
    assert seen <= {(each.log_time_ns, each.message.SerializeToString()) for each in read_log(log, ["/wheels"])}


def test_a_viewer_that_does_not_read_takes_nothing_from_the_recording(tmp_path: Path) -> None:
    port = free_port()
    with serving(tmp_path, tag_jpeg(), f"{{picture_rate_hz: 15, foxglove: {port}}}") as (served, driver):
        with ExitStack() as stack:
            for _ in range(20):
                stack.enter_context(watching(port)).subscribe("/wheels", "/camera/image", PREVIEW_TOPIC)
            for _ in range(200):  # what is no WebSocket
                stranger = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
                stranger.sendall(b"\x00\xff" * 1000)
            served.wait_for_state(lambda state: state["picture"] > 20)
            assert len(page_processes(served.process.pid)) == 1
        said = served.end()
    assert served.process.returncode == 0
    assert "lost: " not in said
    assert driver.refused == []


def test_only_so_many_viewers_get_messages(viewer: tuple[Served, int]) -> None:
    with ExitStack() as stack:
        watchers = [stack.enter_context(watching(viewer[1])) for _ in range(MOST_VIEWERS + 1)]
        for each in watchers:
            each.subscribe("/wheels")
            if each is not watchers[-1]:
                each.next_of("/wheels", WheelEncoders)
        with pytest.raises(TimeoutError):
            watchers[-1].receive(1.0)


def test_a_port_that_another_program_has_leaves_the_page_alone(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        hub = FakeHub()
        settings = PageSettings("gb1", None, None, PageAddress("127.0.0.1", port))
        threading.Thread(target=_serve_viewers, args=(hub, settings.viewer, settings), daemon=True).start()
        until(lambda: len(hub.notices) > 0, "a notice")
        assert hub.notices[0].startswith(f"foxglove 127.0.0.1:{port}: cannot be served there (")


class FakeHub:
    def __init__(self) -> None:
        self.notices: list[str] = []
        self.report_notice = self.notices.append

    def report_topics(self, _topics: frozenset[str]) -> None:
        pass

    def set_viewer(self, _viewer: Viewer) -> None:
        pass


def test_a_recording_for_viewers_alone_has_no_page(tmp_path: Path) -> None:
    port = free_port()
    robot = robot_yaml(tmp_path, "{camera: pictures}", f"{{foxglove: {port}}}")
    program = [sys.executable, "-m", "groundsbot.onboard.cli", "record"]
    with running([*program, "--robot", robot, "--output", tmp_path / "logs"]) as process:
        assert process.stdout is not None
        said = "".join(itertools.takewhile(lambda line: "recording_started" not in line, process.stdout))
        assert f"foxglove: ws://127.0.0.1:{port}" in said
        assert "page:" not in said
        with watching(port) as watcher:
            assert watcher.channels.keys() == viewer_topics(("",))
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_S)


def test_each_camera_has_topics_and_its_picture_on_the_page(tmp_path: Path) -> None:
    port, enough = free_port(), threading.Event()
    robot = two_cameras_yaml(tmp_path, f"{{picture_rate_hz: 1000, foxglove: {port}, page: {free_port()}}}")
    cameras = {name: PictureFolder(tmp_path / name, keep=30) for name in ("front", "left")}

    def show() -> None:
        for _ in itertools.takewhile(lambda _: not enough.is_set(), pace(10.0)):
            for camera in cameras.values():
                camera.show(tag_jpeg())

    program = [sys.executable, "-m", "groundsbot.onboard.cli", "record"]
    with running([*program, "--robot", robot, "--output", tmp_path / "logs"]) as process:
        threading.Thread(target=show, daemon=True).start()
        assert process.stdout is not None
        said = "".join(itertools.takewhile(lambda line: "recording_started" not in line, process.stdout))
        page = Served(process, re.findall(r"page: (\S+)", said)[0], tmp_path / "logs")
        with watching(port, tuple(cameras)) as watcher:
            for name in cameras:
                preview, detections = f"/camera/{name}/preview", f"/tags/{name}/detections"
                watcher.subscribe(preview, detections)
                assert watcher.next_of(detections, TagDetections).detections[0].tag_id == 9
                assert decode(watcher.next_of(preview, CompressedImage).data).shape == (120, 160, 3)
        with watching(port, tuple(cameras)) as late:
            late.subscribe("/tf")
            frames = {late.next_of("/tf", FrameTransform).child_frame_id.rpartition("/")[2] for _ in range(2)}
            assert frames == {"camera_front", "camera_left"}
        rows = page.wait_for_state(lambda state: len([row for row in state["rows"] if row[2] == "good"]) > 2)["rows"]
        assert {"camera front", "camera left"} <= {row[0] for row in rows}
        assert decode(page.ask("/picture")[1]).shape == (120, 320, 3)
        enough.set()
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_S)


def _is_served(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        address = f"127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(CalibError, match=rf"foxglove {address}: .*in use.*; give another port"):
            listen_at(parse_page_address(address), "foxglove")


@pytest.mark.parametrize(
    ("file", "cameras", "picture"),
    [
        ("foxglove_live.json", ("",), PREVIEW_TOPIC),
        ("foxglove_live_two_cameras.json", ("front", "left"), PREVIEW_TOPIC),
        ("foxglove_log_two_cameras.json", ("front", "left"), PICTURE_TOPIC),
    ],
)
def test_the_layout_names_topics_and_fields_that_are_there(file: str, cameras: tuple[str, ...], picture: str) -> None:
    layout = json.loads((ROOT / "docs" / "robot" / file).read_text(encoding="utf-8"))
    panels = layout["configById"]
    assert panels_in(layout["layout"]) == set(panels)
    images = {each["imageMode"]["imageTopic"] for name, each in panels.items() if name.startswith("Image")}
    assert images == {camera_topic(picture, name) for name in cameras}
    for path in panels["Plot!wheels"]["paths"]:
        topic, field, modifier = path["value"].split(".")
        assert field in TOPICS[topic].schema.DESCRIPTOR.fields_by_name
        assert modifier == "@derivative"
    raw = {each["topicPath"] for name, each in panels.items() if name.startswith("RawMessages")}
    drawn = {topic for name, each in panels.items() if name.startswith("3D") for topic in each["topics"]}
    assert raw | drawn <= viewer_topics(cameras)
