"""map.mcap, read back by the libraries that made the format: MCAP's reader with Foxglove's schemas."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from groundsbot.offline.maps.mcap import write_mcap
from groundsbot.offline.maps.result import MapResult, TagPose
from groundsbot.offline.maps.shape import shape_of
from groundsbot.onboard.log.messages import TOPICS
from tests.support.data.maps import make_component, make_map

T_BASE_CAMERA = np.array([0.2, 0.05, 0.4, -0.5, 0.5, -0.5, 0.5])


def read_back(result: MapResult, path: Path) -> list[tuple[str, str, int, Any]]:
    """Topic, schema, log time and decoded message of all there is."""
    write_mcap(result, path)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [
            (channel.topic, schema.name, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False)
            if schema is not None
        ]


def of_topic(found: list[tuple[str, str, int, Any]], topic: str) -> list[Any]:
    return [decoded for name, _, _, decoded in found if name == topic]


def heading(q: Any) -> float:
    return float(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("zyx")[0])


def test_the_drive_plays_over_the_map_on_the_logs_time_line(tmp_path: Path) -> None:
    component = make_component()
    later = 5_000_000_000
    first, second = component.runs
    second = replace(second, stamps_ns=second.stamps_ns + later, T_base_camera=T_BASE_CAMERA)
    result = make_map(replace(component, runs=(first, second)))
    found = read_back(result, tmp_path / "map.mcap")

    times = [at for _, _, at, _ in found]
    assert times == sorted(times)
    for _, _, at, message in (each for each in found if each[0] == "/map/tf"):
        assert {each.timestamp.ToNanoseconds() for each in message.transforms} == {at}
    transforms = [each for message in of_topic(found, "/map/tf") for each in message.transforms]
    for run in (first, second):
        moved = [each for each in transforms if each.child_frame_id == f"{run.name}/base"]
        assert {each.parent_frame_id for each in moved} == {"map"}
        assert [each.timestamp.ToNanoseconds() for each in moved] == run.stamps_ns.tolist()
        poses = [[each.translation.x, each.translation.y, heading(each.rotation)] for each in moved]
        np.testing.assert_allclose(poses, run.T_map_base, atol=1e-12)
    camera, *again = (each for each in transforms if each.child_frame_id.endswith("/camera"))
    assert len(again) == len(second.stamps_ns) - 1
    assert (camera.parent_frame_id, camera.child_frame_id) == ("blue_two/base", "blue_two/camera")
    place, turn = camera.translation, camera.rotation
    assert [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w] == T_BASE_CAMERA.tolist()
    assert camera.timestamp.ToNanoseconds() == second.stamps_ns[0]

    still = [(schema, at) for topic, schema, at, _ in found if topic != "/map/tf"]
    assert {at for _, at in still} == {int(first.stamps_ns[0])}
    assert {schema for schema, _ in still} == {"foxglove.SceneUpdate", "foxglove.PosesInFrame"}


def test_tags_stand_where_the_map_has_them_with_their_ellipses(tmp_path: Path) -> None:
    component = make_component()
    (scene,) = of_topic(read_back(make_map(component), tmp_path / "map.mcap"), "/map/tags")
    assert [entity.id for entity in scene.entities] == ["tag36h11:3", "tag36h11:7", "tag25h9:3"]
    shape = shape_of(component)
    assert shape is not None
    for entity, tag, own in zip(scene.entities, component.tags, shape.tag_covariances, strict=True):
        assert entity.frame_id == "map"
        assert (entity.lifetime.seconds, entity.lifetime.nanos) == (0, 0)
        (ball,), (ellipse,), (text,) = entity.spheres, entity.cylinders, entity.texts
        for each in (ball, ellipse, text):
            assert [each.pose.position.x, each.pose.position.y] == tag.position_m.tolist()
        assert text.text == str(tag.tag_id)
        turn = heading(ellipse.pose.orientation)
        axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        spread = axes @ np.diag([(ellipse.size.x / 2) ** 2, (ellipse.size.y / 2) ** 2]) @ axes.T
        np.testing.assert_allclose(spread, chi2.ppf(0.95, 2) * own, atol=1e-12)
        said = {pair.key: pair.value for pair in entity.metadata}
        assert said["ellipse"] == "95 %, relative to the other tags"
        assert float(said["ellipse_sigma_x_m"]) == pytest.approx(own[0, 0] ** 0.5, abs=1e-4)
        assert float(said["sigma_x_m"]) == pytest.approx(tag.covariance[0, 0] ** 0.5, abs=1e-4)
        assert said["runs"] == " ".join(tag.runs)
        assert said["n_observations"] == str(tag.n_observations)


def test_tags_are_at_their_poses_in_a_map_of_corners(tmp_path: Path) -> None:
    component = make_component()
    pose = TagPose(1.7, Rotation.from_euler("ZYX", [0.4, 0.2, 1.5]).as_quat(), 1e-4 * np.eye(6))
    first, *others = component.tags
    component = replace(component, tags=(replace(first, pose=pose), *others))
    (scene,) = of_topic(read_back(make_map(component), tmp_path / "map.mcap"), "/map/tags")
    mounted, flat, _ = scene.entities
    q = mounted.spheres[0].pose.orientation
    assert [q.x, q.y, q.z, q.w] == pose.quaternion_xyzw.tolist()
    assert mounted.spheres[0].pose.position.z == 1.7
    assert flat.spheres[0].pose.position.z == 0.0
    assert mounted.cylinders[0].pose.position.z == 0.0
    assert mounted.texts[0].pose.position.z > 1.7
    assert {pair.key: pair.value for pair in mounted.metadata}["height_m"] == "1.7000"


def test_trajectories_are_there_whole_as_lines_and_poses(tmp_path: Path) -> None:
    component = make_component()
    found = read_back(make_map(component), tmp_path / "map.mcap")
    (scene,) = of_topic(found, "/map/runs")
    assert [entity.id for entity in scene.entities] == ["red_one", "blue_two"]
    for entity, run in zip(scene.entities, component.runs, strict=True):
        points = [[point.x, point.y] for point in entity.lines[0].points]
        assert points == run.T_map_base[:, :2].tolist()
        (poses,) = of_topic(found, f"/map/{run.name}/keyframes")
        assert poses.frame_id == "map"
        assert [[pose.position.x, pose.position.y] for pose in poses.poses] == points


def test_components_have_frames_of_their_own(tmp_path: Path) -> None:
    found = read_back(make_map(make_component(), make_component("green_one", "grey_two")), tmp_path / "map.mcap")
    transforms = [each for message in of_topic(found, "/map/tf") for each in message.transforms]
    parents = {each.child_frame_id: each.parent_frame_id for each in transforms}
    assert parents == {
        "red_one/base": "map",
        "blue_two/base": "map",
        "green_one/base": "map2",
        "grey_two/base": "map2",
    }
    (scene,) = of_topic(found, "/map/tags/map2")
    assert {entity.frame_id for entity in scene.entities} == {"map2"}


def test_no_topic_is_one_of_a_log_with_another_schema(tmp_path: Path) -> None:
    topics = {topic for topic, _, _, _ in read_back(make_map(), tmp_path / "map.mcap")}
    assert not topics & set(TOPICS)
