"""A wheel controller reset while the robot rolls on: what was driven is unknown. A row of the table of faults."""

import json
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.robot_yaml import Wheels
from groundsbot.fixtures.drives.true_motion import TrueMotion
from groundsbot.fixtures.drives.wheel_controller import Controller, TimedLine
from groundsbot.fixtures.recording import feed
from groundsbot.fixtures.simulate import simulate
from groundsbot.fixtures.worlds.world import Waypoint, World, load_world
from groundsbot.offline.measurements.run import load_run
from groundsbot.onboard.log.messages import EventKind
from groundsbot.onboard.log.reading.reader import find_logs
from groundsbot.onboard.wheels.protocol import WheelLine, format_line, parse_line
from tests.support.devices.recorder_cores import PERIOD_NS, START_NS, S, events_of, line_of, make_core, send, wheels_of
from tests.support.programs import Run

AWAY_S = 20.0
RESET_AT_S = 30.0
_NS_PER_S = 1_000_000_000


def slow_rounds() -> World:
    """Robot a going round the room twice at 0.3 m/s: in 20 s it does more than 5 m."""
    world = load_world("room")
    robot = world.robot("a")
    corners = [(4.8, 1.0), (4.8, 3.0), (1.2, 3.0), (1.2, 1.0)] * 2
    waypoints = [Waypoint(x_m=x_m, y_m=y_m, corner_radius_m=0.5) for x_m, y_m in corners[:-1]]
    route = robot.route.model_copy(update={"waypoints": waypoints, "speed_m_s": 0.3})
    return world.model_copy(update={"robots": [robot.model_copy(update={"route": route})]})


class ResetController(Controller):
    """Says nothing for 20 s and then begins anew, all counts at zero."""

    new_boot = True

    def lines(self, drive: TrueMotion, wheels: Wheels) -> list[TimedLine]:
        """As a controller's, but for the reset."""
        lines = super().lines(drive, wheels)
        away_ns = [round(each * _NS_PER_S) for each in (RESET_AT_S, RESET_AT_S + AWAY_S)]
        before = [line for line in lines if line.arrival_ns < away_ns[0]]
        after = [line for line in lines if line.arrival_ns >= away_ns[1]]
        first = parse_line(after[0].data[:-1])
        assert isinstance(first, WheelLine)
        again = []
        for timed in after:
            line = parse_line(timed.data[:-1])
            assert isinstance(line, WheelLine)
            reset = line._replace(
                boot_id=line.boot_id + self.new_boot,
                sequence=line.sequence - first.sequence,
                t_us=line.t_us - first.t_us + 700,
                ticks_left=line.ticks_left - first.ticks_left,
                ticks_right=line.ticks_right - first.ticks_right,
            )
            again.append(TimedLine(timed.arrival_ns, format_line(reset)))
        return before + again


@pytest.mark.parametrize("new_boot", [True, False])
def test_row_29_a_reset_in_mid_run_begins_a_new_segment_of_the_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run, new_boot: bool
) -> None:
    monkeypatch.setattr(ResetController, "new_boot", new_boot)
    monkeypatch.setattr(feed, "Controller", ResetController)
    truth = simulate(slow_rounds(), 29, tmp_path / "logs", robots=["a"], render=False)
    (log,) = find_logs([tmp_path / "logs"])
    (told,) = events_of(log, EventKind.WHEEL_RESET)
    assert "unknown" in told.text
    loaded = load_run(log)
    first, second = (stretch.stamps_ns for stretch in loaded.wheel_segments)
    assert AWAY_S - 0.1 < (second[0] - first[-1]) / _NS_PER_S < AWAY_S + 1.0
    (true,) = truth.runs.values()
    away = true.at(np.linspace(first[-1], second[0], 200).astype(np.int64))
    assert np.hypot(*np.diff(away[:, :2], axis=0).T).sum() > 4.5  # rolled on

    outcome = run("map", log, "-o", tmp_path / "map")
    assert outcome.code in (0, 3), outcome.err
    entries = json.loads((tmp_path / "map" / "map.json").read_text())["runs"]
    assert [entry["run"] for entry in entries] == [loaded.name, f"{loaded.name}_stretch2"]
    T_map_start = np.array(entries[1]["T_map_start"])
    T_true_start = se2.between(true.at(first[0]), true.at(second[0]))
    T_if_it_stood_still = se2.between(true.at(first[0]), true.at(first[-1]))
    error_m = np.hypot(*(T_map_start - T_true_start)[:2])
    assert np.hypot(*(T_if_it_stood_still - T_true_start)[:2]) > 1.0
    sigmas_m = np.sqrt(np.diag(np.array(entries[1]["covariance"]))[:2])
    assert error_m < 5.0 * np.hypot(*sigmas_m)
    assert error_m < 0.1


def test_row_29_the_recorder_reports_the_reset_and_counts_anew(tmp_path: Path) -> None:
    core, now_ns = make_core(tmp_path), START_NS
    for index in range(300):
        now_ns = send(core, index)
    for index in range(200):
        now_ns = START_NS + 23 * S + index * PERIOD_NS
        core.on_serial_bytes(format_line(line_of(index, boot_id=8)), now_ns)
    core.close(now_ns + S)
    readings = wheels_of(tmp_path / "run1")
    assert [reading.ticks_left for reading in readings] == [13 * index for index in [*range(300), *range(200)]]
    assert [reading.boot_id for reading in readings] == [7] * 300 + [8] * 200
    (told,) = events_of(tmp_path / "run1", EventKind.WHEEL_RESET)
    assert "after 20.009 s" in told.text
    assert core.losses == {"wheel controller resets": 1}
