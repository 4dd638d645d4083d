"""What `export` writes is read back by the tools it is meant for."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from groundsbot.calib.geometry import se2
from groundsbot.offline.export.frame import in_frame_of
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.fit_results import OutlierTag
from groundsbot.offline.maps.result import Component
from groundsbot.onboard.log.messages import TagDetections, WheelEncoders
from groundsbot.onboard.log.reading.reader import read_log
from tests.support.data.drives import make_robot
from tests.support.data.maps import make_component, make_map
from tests.support.programs import Outcome, Run


@pytest.fixture
def exported(run: Run, folder: Path, tmp_path: Path) -> Callable[..., tuple[Path, Outcome]]:
    """What `export DIR --format FORMAT` writes, and says."""

    def call(form: str, *arguments: object) -> tuple[Path, Outcome]:
        output = tmp_path / f"out_{form}"
        outcome = run("export", folder, "--format", form, "-o", output, *arguments)
        assert outcome.code == 0, outcome.err
        return output, outcome

    return call


def component_of(folder: Path) -> Component:
    (component,) = read_map(folder).components
    return component


def test_evo_reads_the_trajectories(
    exported: Callable[..., tuple[Path, Outcome]], folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # where evo keeps its settings
    from evo.tools import file_interface

    output, _ = exported("tum")
    runs = component_of(folder).runs
    assert sorted(each.name for each in output.iterdir()) == sorted(f"{run.name}.tum" for run in runs)
    for run in runs:
        trajectory = file_interface.read_tum_trajectory_file(output / f"{run.name}.tum")
        valid, problems = trajectory.check()
        assert valid, problems
        np.testing.assert_allclose(trajectory.timestamps, run.stamps_ns * 1e-9, rtol=0, atol=1e-6)
        np.testing.assert_allclose(trajectory.positions_xyz[:, :2], run.T_map_base[:, :2], atol=1e-9)
        headings = [np.arctan2(pose[1, 0], pose[0, 0]) for pose in trajectory.poses_se3]
        np.testing.assert_allclose(se2.wrap_angle(headings - run.T_map_base[:, 2]), 0.0, atol=1e-9)


def test_gtsam_reads_the_graph_and_finds_the_map_in_it(
    exported: Callable[..., tuple[Path, Outcome]], folder: Path
) -> None:
    import gtsam

    output, _ = exported("g2o")
    component = component_of(folder)
    poses = np.concatenate([run.T_map_base for run in component.runs])
    tags = np.array([tag.position_m for tag in component.tags])
    graph, values = gtsam.readG2o(str(output), False)
    edges = component.edges
    assert edges is not None
    assert graph.size() == len(edges.first)
    read = [values.atPose2(i) for i in range(len(poses))]
    np.testing.assert_allclose([[p.x(), p.y(), p.theta()] for p in read], poses, atol=1e-12)

    # gtsam's reader passes over EDGE_SE2_XY, so these lines are handed to it one by one.
    places = [values.atPoint2(gtsam.symbol("l", len(poses) + i)) for i in range(len(tags))]
    np.testing.assert_allclose(places, tags, atol=1e-12)
    n_seen = 0
    for line in output.read_text().splitlines():
        kind, *words = line.split()
        if kind == "EDGE_SE2_XY":
            n_seen += 1
            graph.add(place_factor(gtsam, int(words[0]), int(words[1]), [float(word) for word in words[2:]]))
    assert n_seen == len(edges.pose)
    graph.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-9)))
    moved = se2.compose(poses[5], [0.03, -0.02, 0.01])
    values.update(5, gtsam.Pose2(*moved))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-12)
    settings.setAbsoluteErrorTol(1e-9)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()

    optimum = [found.atPose2(i) for i in range(len(poses))]
    np.testing.assert_allclose([[p.x(), p.y()] for p in optimum], poses[:, :2], rtol=0, atol=2e-5)
    np.testing.assert_allclose(se2.wrap_angle([p.theta() for p in optimum] - poses[:, 2]), 0.0, atol=2e-5)
    found_tags = [found.atPoint2(gtsam.symbol("l", len(poses) + i)) for i in range(len(tags))]
    np.testing.assert_allclose(found_tags, tags, rtol=0, atol=2e-5)
    # What the solve's loss bounded counts no more than there; the calibration's share is not in the graph.
    prior = 0.5 * sum((each.value / each.prior_sigma) ** 2 for each in read_map(folder).calibration)
    cost = component.cost - prior
    assert 0.9 * cost < graph.error(found) < cost * (1.0 + 1e-9)


def place_factor(gtsam: Any, pose: int, tag: int, words: list[float]) -> Any:
    """A tag's place in base, as g2o's EdgeSE2PointXY has it."""
    x, y, xx, xy, yy = words
    noise = gtsam.noiseModel.Gaussian.Information(np.array([[xx, xy], [xy, yy]]))
    keys = [pose, gtsam.symbol("l", tag)]

    def error(_factor: Any, values: Any, jacobians: Any) -> Any:
        T, place = values.atPose2(keys[0]), values.atPoint2(keys[1])
        in_base = T.transformTo(place)
        if jacobians is not None:
            cos, sin = np.cos(T.theta()), np.sin(T.theta())
            jacobians[0] = np.array([[-1.0, 0.0, in_base[1]], [0.0, -1.0, -in_base[0]]])
            jacobians[1] = np.array([[cos, sin], [-sin, cos]])
        return in_base - np.array([x, y])

    return gtsam.CustomFactor(noise, keys, error)


def test_g2o_names_what_its_vertices_are(exported: Callable[..., tuple[Path, Outcome]], folder: Path) -> None:
    output, outcome = exported("g2o")
    component = component_of(folder)
    lines = output.read_text().splitlines()
    first, second = component.runs
    n = first.n_keyframes
    assert f"# run {first.name}: vertices 0 to {n - 1}" in lines
    assert f"# run {second.name}: vertices {n} to {n + second.n_keyframes - 1}" in lines
    tag, vertex = component.tags[1], n + second.n_keyframes + 1
    assert f"# tag {tag.family} {tag.tag_id}: vertex {vertex}" in lines
    assert f"VERTEX_XY {vertex} " + " ".join(map(repr, tag.position_m.tolist())) in lines
    assert lines.count("FIX 0") == 1
    assert outcome.out.splitlines()[0] == f"2 runs, {len(component.tags)} tags, in the frame of carl_one's start"


def test_csv_has_tags_and_stamped_trajectories(exported: Callable[..., tuple[Path, Outcome]], folder: Path) -> None:
    output, _ = exported("csv")
    assert (output / "tags.csv").read_bytes() == (folder / "tags.csv").read_bytes()
    for run in component_of(folder).runs:
        rows = list(csv.DictReader((output / f"{run.name}.csv").open(encoding="utf-8")))
        assert [int(row["t_ns"]) for row in rows] == run.stamps_ns.tolist()
        poses = [[float(row[name]) for name in ("x_m", "y_m", "theta_rad")] for row in rows]
        np.testing.assert_allclose(poses, run.T_map_base, atol=1e-9)


def test_any_export_goes_through_a_frame(exported: Callable[..., tuple[Path, Outcome]], folder: Path) -> None:
    component = component_of(folder)
    first, second, *_ = component.tags
    output, outcome = exported("csv", "--frame", f"{first.tag_id},{second.tag_id}")
    assert outcome.out.splitlines()[0].endswith(f"in the frame of tags {first.tag_id} and {second.tag_id}")
    rows = list(csv.DictReader((output / "tags.csv").open(encoding="utf-8")))
    distance_m = np.hypot(*(second.position_m - first.position_m))
    places = [[float(row["x_m"]), float(row["y_m"])] for row in rows[:2]]
    np.testing.assert_allclose(places, [[0.0, 0.0], [distance_m, 0.0]], atol=1e-6)
    assert max(float(row["sigma_y_m"]) for row in rows[:2]) < 1e-6
    run = component.runs[1]
    start = next(csv.DictReader((output / f"{run.name}.csv").open(encoding="utf-8")))
    away_m = np.hypot(float(start["x_m"]), float(start["y_m"]))
    assert away_m == pytest.approx(np.hypot(*(run.T_map_start[:2] - first.position_m)), abs=1e-6)


def test_a_map_in_its_tags_axes_is_exported_from_a_start(run: Run, folder: Path, tmp_path: Path) -> None:
    (component,) = read_map(folder).components
    framed, _ = in_frame_of(component, "shape")
    (tmp_path / "map").mkdir()
    write_map(replace(read_map(folder), components=(framed,)), tmp_path / "map")
    outcome = run("export", tmp_path / "map", "--format", "csv", "--frame", "start", "-o", tmp_path / "csv")
    assert (outcome.code, outcome.err) == (0, "")
    found, own = (
        list(csv.DictReader((each / "tags.csv").open(encoding="utf-8"))) for each in (tmp_path / "csv", folder)
    )
    for a, b in zip(found, own, strict=True):
        for name in ("x_m", "y_m", "sigma_x_m", "sigma_y_m", "shape_sigma_x_m"):
            assert float(a[name]) == pytest.approx(float(b[name]), abs=2e-6)


def metres_between(a: list[float], b: list[float]) -> float:
    """Across the ellipsoid, by its radii of curvature there: good to a part in a million over some metres."""
    middle = np.radians(0.5 * (a[1] + b[1]))
    e2, w = 0.0066943799901413165, np.sqrt(1.0 - 0.0066943799901413165 * np.sin(middle) ** 2)
    north = np.radians(b[1] - a[1]) * 6378137.0 * (1.0 - e2) / w**3
    east = np.radians(b[0] - a[0]) * 6378137.0 / w * np.cos(middle)
    return float(np.hypot(east, north))


def test_geojson_puts_the_map_on_the_earth(exported: Callable[..., tuple[Path, Outcome]], folder: Path) -> None:
    output, _ = exported("geojson", "--origin", "48.2,11.6,90")
    component = component_of(folder)
    features = json.loads(output.read_text())["features"]
    assert [each["geometry"]["type"] for each in features] == ["Point"] * len(component.tags) + ["LineString"] * 2
    places = {each["properties"]["tag_id"]: each["geometry"]["coordinates"] for each in features[:-2]}
    for tag in component.tags:
        assert metres_between([11.6, 48.2], places[tag.tag_id]) == pytest.approx(np.hypot(*tag.position_m), abs=1e-3)
        # x to the east, so y, which is to its left, to the north
        lon, lat = places[tag.tag_id]
        assert (lon > 11.6, lat > 48.2) == (tag.position_m[0] > 0.0, tag.position_m[1] > 0.0)
    assert features[-2]["geometry"]["coordinates"][0] == [11.6, 48.2]
    assert len(features[-1]["geometry"]["coordinates"]) == component.runs[1].n_keyframes
    tag = component.tags[0]
    said = features[0]["properties"]
    assert said["sigma_east_m"] == pytest.approx(np.sqrt(tag.covariance[0, 0]))
    assert said["sigma_north_m"] == pytest.approx(np.sqrt(tag.covariance[1, 1]))


def test_geojson_turns_the_map_as_it_looks(exported: Callable[..., tuple[Path, Outcome]], folder: Path) -> None:
    output, _ = exported("geojson", "--origin", "48.2,11.6,0")
    tags = component_of(folder).tags
    for feature, tag in zip(json.loads(output.read_text())["features"], tags, strict=False):
        lon, lat = feature["geometry"]["coordinates"]
        # x to the north, so y, which is to its left, to the west
        assert (lat > 48.2, lon < 11.6) == (tag.position_m[0] > 0.0, tag.position_m[1] > 0.0)


def test_the_maps_mcap_runs_on_the_time_line_of_the_logs(folder: Path) -> None:
    with (folder / "map.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = [each.decoded_message for each in reader.iter_decoded_messages(topics=["/map/tf"])]
    transforms = [each for message in found for each in message.transforms]
    for run in component_of(folder).runs:
        messages = [each.message for each in read_log(run.log, topics=["/wheels", "/tags/detections"])]
        wheels = [each.stamp_ns for each in messages if isinstance(each, WheelEncoders)]
        pictures = [each.stamp_ns for each in messages if isinstance(each, TagDetections)]
        stamps = [each.timestamp.ToNanoseconds() for each in transforms if each.child_frame_id == f"{run.name}/base"]
        assert stamps[0] == wheels[0]
        assert set(stamps[1:]) <= set(pictures)


def test_cameras_sit_where_the_solve_found_them(folder: Path) -> None:
    result = read_map(folder)
    for run in result.components[0].runs:
        found = {each.name: each.value for each in result.calibration if each.owner == run.robot_id}
        mount = make_robot(run.robot_id).mount
        corrected = mount.model_copy(
            update={
                name: getattr(mount, name) + found[f"mount_{name}"]
                for name in ("x_m", "y_m", "yaw_rad", "pitch_rad", "roll_rad")
            }
        )
        place, turn = corrected.T_base_camera.as_components()
        assert run.T_base_camera is not None
        np.testing.assert_allclose(run.T_base_camera, [*place, *turn.as_quat(canonical=True)], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--format", "geojson"), "--origin LAT_DEG,LON_DEG,HEADING_DEG"),
        (("--format", "geojson", "--origin", "48.2,11.6"), "must be LAT_DEG,LON_DEG,HEADING_DEG"),
        (("--format", "geojson", "--origin", "111.6,48.2,0"), "latitude comes first"),
        (("--format", "g2o", "--origin", "48.2,11.6,0"), "is not used by --format g2o"),
        (("--format", "tum", "--component", "2"), "has no such component"),
    ],
)
def test_what_is_not_known_is_not_made_up(
    run: Run, folder: Path, tmp_path: Path, arguments: tuple[str, ...], named: str
) -> None:
    outcome = run("export", folder, "-o", tmp_path / "out", *arguments)
    assert (outcome.code, outcome.out) == (1, "")
    assert named in outcome.err
    assert outcome.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", ["tum", "g2o"])
def test_nothing_is_written_over(run: Run, folder: Path, tmp_path: Path, form: str) -> None:
    output = tmp_path / "mine"
    output.write_text("precious")
    outcome = run("export", folder, "--format", form, "-o", output)
    assert outcome.code == 1
    assert "exists already" in outcome.err
    assert output.read_text() == "precious"


def test_one_of_several_components_must_be_chosen(run: Run, tmp_path: Path) -> None:
    write_map(make_map(make_component(), make_component("green_one", "grey_two")), tmp_path)
    outcome = run("export", tmp_path, "--format", "tum", "-o", tmp_path / "out")
    assert outcome.code == 1
    assert "2 (frame of green_one, 2 runs, 3 tags)" in outcome.err
    outcome = run("export", tmp_path, "--format", "tum", "-o", tmp_path / "out", "--component", 2)
    assert outcome.code == 0
    assert sorted(each.name for each in (tmp_path / "out").iterdir()) == ["green_one.tum", "grey_two.tum"]


def test_a_map_without_its_graph_is_an_error(run: Run, tmp_path: Path) -> None:
    write_map(make_map(), tmp_path)
    outcome = run("export", tmp_path, "--format", "g2o", "-o", tmp_path / "out.g2o")
    assert outcome.code == 1
    assert "make the map again" in outcome.err
    assert not (tmp_path / "out.g2o").exists()


def test_tags_that_the_map_mistrusts_are_named(run: Run, tmp_path: Path) -> None:
    suspects = (OutlierTag("tag36h11", 3, "moved", ("blue_two",), "it is 2 m off"),)
    write_map(replace(make_map(), outliers=suspects), tmp_path)
    outcome = run("export", tmp_path, "--format", "tum", "-o", tmp_path / "out")
    assert "warning: suspect: tag 3 (tag36h11) moved: it is 2 m off" in outcome.out


def test_measurements_by_hand_are_reported_as_not_exported(run: Run, folder: Path, tmp_path: Path) -> None:
    result = replace(read_map(folder), measurements=make_map().measurements)
    write_map(result, tmp_path)
    outcome = run("export", tmp_path, "--format", "g2o", "-o", tmp_path / "out.g2o")
    assert "warning: --start and --distance measurements are not exported" in outcome.out
