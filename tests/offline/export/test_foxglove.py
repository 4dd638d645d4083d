"""A log opened with map.mcap and what `export --format foxglove` writes: topics, frames and times agree."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from google.protobuf.message import Message
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import RigidTransform, Rotation

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.export.foxglove import LAYOUT_FILE, write_foxglove
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.result import Component, RunResult
from groundsbot.onboard.log.messages import CameraCalibration, Event, FrameTransform, TagDetections
from groundsbot.onboard.log.reading.reader import read_head, read_log
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.drives import make_drive
from tests.support.data.exported_map import LEGS, STARTS
from tests.support.data.logs import START_NS, picture_entry
from tests.support.data.map_cases import rewritten
from tests.support.data.maps import make_map
from tests.support.foxglove import panels_in
from tests.support.programs import Run


class Found(NamedTuple):
    topic: str
    schema: str
    message: Any


@pytest.fixture(scope="module")
def view(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("view")
    write_foxglove(component_of(folder), output)
    return output


def component_of(folder: Path) -> Component:
    (component,) = read_map(folder).components
    return component


def messages_of(path: Path) -> list[Found]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [
            Found(channel.topic, schema.name, decoded)
            for schema, channel, _, decoded in reader.iter_decoded_messages()
            if schema is not None
        ]


def opened(folder: Path, view: Path, run: RunResult, tmp_path: Path) -> list[Found]:
    """What a viewer has of one run: its log with a picture and an event, the map, and the view."""
    with LogWriter(tmp_path / "pictures.mcap", read_head(run.log), START_NS, durable=False) as writer:
        at_ns = int(run.stamps_ns[-1])
        writer.write("/events", Event(stamp_ns=at_ns), at_ns, at_ns)
        writer.write(*picture_entry(at_ns, b"\xff\xd8\xff\xd9"))
    files = [*run.log.glob("*.mcap"), tmp_path / "pictures.mcap", folder / "map.mcap", view / f"{run.run}.mcap"]
    return [each for file in files for each in messages_of(file)]


def topics_and_paths(layout: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Topic, field (empty: the whole) and schema (empty: any) of all that the panels show."""
    panels = layout["configById"]
    scene = "foxglove.SceneUpdate"
    schemas = {"/map/tags": scene, "/map/runs": scene, "/camera/image": "foxglove.CompressedImage"}
    calibration = "foxglove.CameraCalibration"
    for topic, settings in panels["3D!map"]["topics"].items():
        yield topic, "", schemas.get(topic, calibration)
        if "cameraInfoTopic" in settings:
            yield settings["cameraInfoTopic"], "", calibration
    image = panels["Image!camera"]["imageMode"]
    yield image["imageTopic"], "", "foxglove.CompressedImage"
    yield image["calibrationTopic"], "", calibration
    for topic in image["annotations"]:
        yield topic, "", "foxglove.ImageAnnotations"
    for path in panels["Plot!wheels"]["paths"]:
        topic, _, field = path["value"].partition(".")
        yield topic, field, "groundsbot.WheelSpeeds"
    yield panels["RawMessages!events"]["topicPath"], "", "groundsbot.Event"


def test_every_topic_and_path_of_the_layout_is_there_with_its_schema(folder: Path, view: Path, tmp_path: Path) -> None:
    layout = json.loads((view / LAYOUT_FILE).read_text())
    assert panels_in(layout["layout"]) == set(layout["configById"])
    found = opened(folder, view, component_of(folder).runs[0], tmp_path)
    by_topic = {each.topic: each for each in found}
    wanted = list(topics_and_paths(layout))
    assert len(wanted) > 8
    for topic, field, schema in wanted:
        assert by_topic[topic].schema == schema, topic
        assert not field or field in by_topic[topic].message.DESCRIPTOR.fields_by_name, field
    assert layout["configById"]["3D!map"]["followTf"] == "map"


def test_a_logs_camera_moves_through_the_map_by_way_of_its_odometry(folder: Path) -> None:
    for run in component_of(folder).runs:
        calibration, logged = (read_head(run.log)[topic] for topic in ("/camera/calibration", "/tf"))
        assert isinstance(logged, FrameTransform)
        assert isinstance(calibration, CameraCalibration)
        frame, base = calibration.frame_id, logged.parent_frame_id
        assert logged.child_frame_id == frame
        moves = [each.message.transforms for each in messages_of(folder / "map.mcap") if each.topic == "/map/tf"]
        mine = [{each.child_frame_id: each for each in move} for move in moves]
        mine = [move for move in mine if base in move]
        assert [move[base].timestamp.ToNanoseconds() for move in mine] == run.stamps_ns.tolist()
        assert run.T_base_camera is not None
        mount = RigidTransform.from_components(run.T_base_camera[:3], Rotation.from_quat(run.T_base_camera[3:]))
        expected = [(on_floor(each) * mount).as_matrix() for each in run.T_map_base]
        np.testing.assert_allclose([in_map(move, frame).as_matrix() for move in mine], expected, atol=1e-9)

        odom = f"{run.run}/odom"
        assert {(move[base].parent_frame_id, move[odom].parent_frame_id) for move in mine} == {(odom, "map")}
        true = make_drive(STARTS[run.robot_id].tolist(), LEGS, step_ns=20_000_000)
        driven = se2.between(true.T_world_base[0], true.at(run.stamps_ns))
        by_wheels = [transform_of(move[base]).translation[:2] for move in mine]
        np.testing.assert_allclose(by_wheels, driven[:, :2], atol=0.005)  # but for ticks


def on_floor(pose: FloatArray) -> RigidTransform:
    x, y, theta = pose.tolist()
    return RigidTransform.from_components([x, y, 0.0], Rotation.from_euler("z", theta))


def transform_of(message: FrameTransform) -> RigidTransform:
    place, q = message.translation, message.rotation
    return RigidTransform.from_components([place.x, place.y, place.z], Rotation.from_quat([q.x, q.y, q.z, q.w]))


def in_map(move: dict[str, FrameTransform], frame: str) -> RigidTransform:
    """The pose of a frame in the map, along the parents."""
    found = RigidTransform.identity()
    while frame != "map":
        found = transform_of(move[frame]) * found
        frame = move[frame].parent_frame_id
    return found


def test_outlines_of_tags_have_the_stamps_of_the_pictures(folder: Path, view: Path) -> None:
    for run in component_of(folder).runs:
        outlines = [each.message for each in messages_of(view / f"{run.run}.mcap") if each.topic == "/view/tags"]
        pictures = [each.message for each in read_log(run.log, ["/tags/detections"])]
        seen = 0
        for outline, picture in zip(outlines, pictures, strict=True):
            assert isinstance(picture, TagDetections)
            stamps = [each.timestamp.ToNanoseconds() for each in (outline, *outline.points, *outline.texts)]
            assert set(stamps) == {picture.stamp_ns}
            assert [each.text for each in outline.texts] == [str(each.tag_id) for each in picture.detections]
            for drawn, tag in zip(outline.points, picture.detections, strict=True):
                corners = [value for point in drawn.points for value in (point.x, point.y)]
                # Foxglove's origin is the first pixel's corner.
                np.testing.assert_allclose(corners, np.array(tag.corners_px) + 0.5, atol=1e-9)
                assert drawn.type == drawn.LINE_LOOP
                seen += 1
        assert seen > 10


def test_wheel_speeds_are_those_driven(folder: Path, view: Path) -> None:
    for run in component_of(folder).runs:
        speeds = [each.message for each in messages_of(view / f"{run.run}.mcap") if each.topic == "/view/wheels"]
        begin = 0
        for left_m_s, right_m_s, seconds in LEGS:
            end = begin + round(10 * seconds)
            found = [(each.left_m_s, each.right_m_s) for each in speeds[begin:end]]
            np.testing.assert_allclose(found, np.tile([left_m_s, right_m_s], (end - begin, 1)), atol=0.02)  # ticks
            begin = end
        assert len(speeds) == begin
        assert set(np.diff([each.stamp_ns for each in speeds]).tolist()) == {100_000_000}


def test_an_older_logs_frames_are_joined_to_the_maps(folder: Path, tmp_path: Path) -> None:
    component = component_of(folder)

    def rename(message: Message) -> None:
        if isinstance(message, FrameTransform):
            message.parent_frame_id, message.child_frame_id = "base", "camera"

    runs = [replace(run, log=rewritten(run.log, tmp_path / run.name, rename)) for run in component.runs]
    write_foxglove(replace(component, runs=tuple(runs)), tmp_path)
    for run in runs:
        found = [each.message for each in messages_of(tmp_path / f"{run.run}.mcap") if each.topic == "/view/tf"]
        ((link,),) = (each.transforms for each in found)
        assert (link.parent_frame_id, link.child_frame_id) == (f"{run.run}/base", "base")
        np.testing.assert_array_equal(transform_of(link).as_matrix(), np.eye(4))


def test_a_log_that_is_not_there_is_one_line(run: Run, tmp_path: Path) -> None:
    made = tmp_path / "map"
    made.mkdir()
    write_map(make_map(), made)
    outcome = run("export", made, "--format", "foxglove", "-o", tmp_path / "view")
    assert outcome.code == 1
    (line,) = outcome.err.splitlines()
    assert "logs/red_one: no such log, of which run red_one was mapped; run `export` in the folder" in line
    assert not (tmp_path / "view").exists()


def test_a_frame_has_no_effect_and_is_refused(run: Run, folder: Path, tmp_path: Path) -> None:
    outcome = run("export", folder, "--format", "foxglove", "--frame", "shape", "-o", tmp_path / "view")
    assert outcome.code == 1
    assert "--frame: is not used by --format foxglove" in outcome.err
