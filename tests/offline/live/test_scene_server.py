"""A map and poses in it, seen by a client of Foxglove's WebSocket protocol."""

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from groundsbot.calib.web import PageAddress
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.live.poses import StampedPose
from groundsbot.offline.live.scene_server import SceneServer, serve_scenes
from groundsbot.offline.localization.online.localizer import OnlinePose
from groundsbot.offline.maps.result import MapResult
from tests.support.data.maps import make_component, make_map
from tests.support.foxglove import Watching, panels_in
from tests.support.paths import ROOT

pytest.importorskip("foxglove", reason="no foxglove-sdk: `make setup` installs it")
client = pytest.importorskip("websockets.sync.client", reason="no websockets: `make setup` installs it")

OF_MAP = ("/map/tags", "/map/runs", "/map/tf")
POSE = StampedPose("gb9_one", 7_000_000_000, OnlinePose(np.array([1.0, -2.0, np.pi / 2]), np.eye(3)), "")


@pytest.fixture
def server() -> Iterator[SceneServer]:
    with closing(SceneServer(PageAddress("127.0.0.1", 0))) as made:
        yield made


@pytest.fixture
def known() -> MapResult:
    return make_map(make_component())


@contextmanager
def watching(server: SceneServer, *topics: str) -> Iterator[Watching]:
    url = f"ws://127.0.0.1:{server.port}"
    with client.connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as connection:
        yield Watching(connection, topics)


def test_who_comes_later_sees_the_map_and_the_robots(known: MapResult, server: SceneServer) -> None:
    server.show_map(known, 5_000_000_000)
    (component,) = known.components
    with watching(server, *OF_MAP, *(f"/map/{run.run}/pose" for run in component.runs)) as watcher:
        watcher.subscribe("/map/tags")
        scene = watcher.next_of("/map/tags", SceneUpdate)
        assert {each.id for each in scene.entities} == {tag.full_label for tag in component.tags}
        watcher.subscribe("/map/tf")
        transforms = watcher.next_of("/map/tf", FrameTransforms).transforms
        assert {each.child_frame_id for each in transforms} == {f"{run.run}/base" for run in component.runs}
        assert {each.parent_frame_id for each in transforms} == {"map"}


def test_tags_that_are_gone_are_removed(known: MapResult, server: SceneServer) -> None:
    """By a deletion of everything older, in the message with what there is now."""
    (component,) = known.components
    others = (replace(component.tags[0], tag_id=99), *component.tags[1:])
    server.show_map(known, 4_000_000_000)
    with watching(server, *OF_MAP, *(f"/map/{run.run}/pose" for run in component.runs)) as watcher:
        watcher.subscribe("/map/tags")
        watcher.next_of("/map/tags", SceneUpdate)
        server.show_map(replace(known, components=(replace(component, tags=others),)), 5_000_000_000)
        scene = watcher.next_of("/map/tags", SceneUpdate)
    assert [each.type for each in scene.deletions] == [SceneEntityDeletion.ALL]
    assert [each.id for each in scene.entities] == [tag.full_label for tag in others]
    assert {each.timestamp.ToNanoseconds() for each in (*scene.entities, *scene.deletions)} == {5_000_000_000}


def test_a_pose_moves_the_frame_of_its_robot(server: SceneServer) -> None:
    server.show_poses([POSE._replace(pose=None), POSE])
    with watching(server, "/map/tf", "/map/gb9_one/pose") as watcher:
        watcher.subscribe("/map/tf")
        (transform,) = watcher.next_of("/map/tf", FrameTransforms).transforms
        assert (transform.parent_frame_id, transform.child_frame_id) == ("map", "gb9_one/base")
        watcher.subscribe("/map/gb9_one/pose")
        found = watcher.next_of("/map/gb9_one/pose", PoseInFrame)
    assert (found.pose.position.x, found.pose.position.y) == (1.0, -2.0)
    assert found.pose.orientation.z == pytest.approx(np.sqrt(0.5))
    assert found.timestamp.ToNanoseconds() == POSE.stamp_ns


@pytest.mark.parametrize("address", ["0", "map", "127.0.0.1:99999"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(OfflineError, match=r"--foxglove .* is not PORT or HOST:PORT"), serve_scenes(address):
        pass


def test_a_port_in_use_is_one_line(server: SceneServer) -> None:
    with pytest.raises(OfflineError, match=r"--foxglove 127.0.0.1:\d+: .*; give another port"):
        SceneServer(PageAddress("127.0.0.1", server.port))


def test_the_layout_names_topics_that_are_there() -> None:
    layout = json.loads((ROOT / "docs" / "robot" / "foxglove_map.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    assert panels_in(layout["layout"]) == set(panels)
    assert panels["3D!map"]["topics"].keys() == {"/map/tags", "/map/runs"}
    assert panels["RawMessages!transforms"]["topicPath"] == "/map/tf"
