"""The fleet benchmark, small: its world holds what it promises, and its table has every stage."""

from pathlib import Path

import numpy as np
import pytest

from groundsbot.fixtures.worlds.world import parse_world
from tests.benchmarks.speed import fleet
from tests.benchmarks.speed.fleet_world import PITCH_M, ROAD_WIDTH_M, TAG_OFFSET_M, fleet_world


def test_the_world_file_is_the_world() -> None:
    assert parse_world(fleet.world_yaml(2, 300, 20, 3), "fleet.yaml") == fleet_world(2, 300, 20, 3)
    assert fleet_world(2, 300, 20, 3) != fleet_world(2, 300, 20, 4)


def test_tags_stand_on_roads_beside_the_way_and_routes_follow_roads() -> None:
    world = fleet_world(3, 1000, 100, 1)
    places = np.array([tag.position_m[:2] for tag in world.tags])
    from_road = np.abs(places - PITCH_M * np.rint(places / PITCH_M))
    assert np.allclose(from_road.min(axis=1), TAG_OFFSET_M)
    assert TAG_OFFSET_M < 0.5 * ROAD_WIDTH_M
    assert len({tag.tag_id for tag in world.tags}) == 100
    for robot in world.robots:
        route = robot.route
        corners = np.array([[route.start.x_m, route.start.y_m], *([w.x_m, w.y_m] for w in route.waypoints)])
        legs = np.diff(corners, axis=0)
        assert np.allclose(np.abs(legs).sum(axis=1), PITCH_M)
        assert (np.abs(legs).min(axis=1) == 0.0).all()
        assert (np.einsum("ij,ij->i", legs[1:], legs[:-1]) >= 0.0).all()  # never turns round


def test_a_small_fleet_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet, "FLEETS", tmp_path)
    logs = fleet.simulated_fleet(2, 500, 40, 1)
    simulated = (logs / "truth.json").stat().st_mtime_ns
    assert fleet.simulated_fleet(2, 500, 40, 1) == logs
    assert (logs / "truth.json").stat().st_mtime_ns == simulated
    line = fleet.measure(logs, workers=1)
    assert (line["robots"], line["workers"]) == (2, 1)
    assert line["bytes"]["map.json"] > 0
    assert 1000 <= line["keyframes"] <= 1500
    # Wheels at 100 Hz and pictures at 15; the head of each log.
    assert abs(line["messages"] - line["keyframes"] * 115 / 15) < 0.25 * line["messages"]
    names = [stage["name"] for stage in line["stages"]]
    assert names[0] == "reading logs"
    assert sum(stage["seconds"] for stage in line["stages"]) < line["seconds"]
    text = "\n".join(fleet.table(line))
    assert all(name in text for name in names)
