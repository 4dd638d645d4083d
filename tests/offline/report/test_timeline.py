"""One drive over time: speed, tags, residuals, gaps and events, and its link with the map."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.measurements.run import load_run
from groundsbot.offline.measurements.run_messages import RunEvent
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.speeds import MOST_TIMES
from groundsbot.offline.report.figures import figures
from groundsbot.offline.report.run_styles import run_styles
from groundsbot.offline.report.timeline import timeline
from tests.offline.report.conftest import Inside
from tests.support.browser import Page
from tests.support.data.drives import START_NS, S, make_drive, make_robot, write_drive
from tests.support.data.map_cases import TAGS
from tests.support.report_reader import data_of

pytest.importorskip("plotly", reason="no plotly: `make setup` installs it; without it there is no report")

MAP = "document.querySelector('.plot.map')"
LINE = "document.querySelector('.plot.timeline')"


def test_timelines_show_speed_tags_gaps_and_events(inside: Inside) -> None:
    result, workings = inside
    document = map_as_json(result)
    first = figures(document, workings)["timelines"][0]
    assert first["run"] == "a_one"
    assert max(first["speed"]["m_s"]) == pytest.approx(0.51, abs=0.02)
    assert max(first["tags"]) == 4
    assert first["t_s"][-1] == pytest.approx(5.5, abs=0.3)
    assert (first["gaps"], first["events"]) == ([], [])
    solved = workings.components[0]
    segment = solved.graph.segments[0]
    track = load_run(segment.run.log).wheel_segments[0]
    kept = (track.stamps_ns < START_NS + 2 * S) | (track.stamps_ns > START_NS + 3 * S)
    holed = replace(track, stamps_ns=track.stamps_ns[kept], left_m=track.left_m[kept], right_m=track.right_m[kept])
    events = (RunEvent(START_NS + S, True, "lost"), RunEvent(START_NS + 100 * S, False, "stopped"))
    changed = replace(segment, speeds=None, run=replace(segment.run, wheel_segments=(holed,), events=events))
    graph = replace(solved.graph, segments=(changed, *solved.graph.segments[1:]))
    lame = Diagnostics(workings.maps, [solved._replace(graph=graph)])
    first = figures(document, lame)["timelines"][0]
    assert first["gaps"] == [[1.99, 3.01]]
    assert [(event["t_s"], event["loss"]) for event in first["events"]] == [(1.0, True), (first["t_s"][-1], False)]
    assert first["events"][0]["text"] == "lost"


@pytest.fixture(scope="module")
def stopping(tmp_path_factory: pytest.TempPathFactory) -> Segment:
    """Two seconds at 0.5 m/s, a stop of three, and two seconds more."""
    drive = make_drive([0.0, 0.0, 0.2], [(0.5, 0.5, 2.0), (0.0, 0.0, 3.0), (0.5, 0.5, 2.0)])
    log = write_drive(tmp_path_factory.mktemp("stop"), drive, TAGS, make_robot("a"), corner_sigma_px=0.3)
    (segment,) = segments_of(read_runs([log])[0], NoiseParameters())
    return segment


def test_the_speed_is_zero_in_a_stop(stopping: Segment) -> None:
    assert np.diff(stopping.stamps_ns).max() > 2.5 * S  # keyframes are joined through the stop
    drawn = timeline(stopping, np.ones(len(stopping.observations)), [], 800)
    step_s, speed = drawn["speed"]["step_s"], np.array(drawn["speed"]["m_s"])
    at_s = (np.arange(len(speed)) + 0.5) * step_s
    stands = (at_s > 2.0 + step_s) & (at_s < 5.0 - step_s)
    assert stands.sum() > 10
    assert speed[stands] == pytest.approx(0.0)
    assert speed[(at_s < 2.0 - step_s) | (at_s > 5.0 + step_s)] == pytest.approx(0.5, abs=0.01)
    assert (speed * step_s).sum() == pytest.approx(stopping.odometry.distance_m.sum(), abs=0.01)
    # A map that is not refined on corners keeps no wheel readings.
    kept = stopping.with_fixed_noise(800)
    assert not kept.run.wheel_segments
    assert timeline(kept, np.ones(len(kept.observations)), [], 800) == drawn
    # An archived map has none either.
    archived = replace(stopping, run=replace(stopping.run, wheel_segments=()))
    speed = np.array(timeline(archived, np.ones(len(stopping.observations)), [], 800)["speed"]["m_s"])
    assert speed[stands].max() < 0.05
    assert speed[at_s < 2.0 - 2 * step_s] == pytest.approx(0.5, abs=0.01)


def test_tags_in_view_are_counted_once(stopping: Segment) -> None:
    twice = stopping.observations.where(np.repeat(np.arange(len(stopping.observations)), 2))
    once, doubled = (
        timeline(replace(stopping, observations=each), np.ones(len(each)), [], 800)
        for each in (stopping.observations, twice)
    )
    assert max(once["tags"]) > 1
    assert doubled["tags"] == once["tags"]


def test_long_drives_are_thinned(inside: Inside) -> None:
    # Ten runs of 10,000 keyframes: what a figure takes may not grow with the drive.
    from groundsbot.offline.report.figures import _MOST_POINTS, _MOST_POINTS_OF_ALL, _trace

    rng = np.random.default_rng(0)
    n, m = 10_000, 30_000
    poses = np.cumsum(np.full((n, 3), 0.0421), axis=0) * 10.0
    stamps_ns = START_NS + np.arange(n) * (S // 10)
    trace = _trace("a_one", run_styles(["a_one"]), poses, stamps_ns)
    assert len(trace["x"]) == len(trace["t_s"]) <= _MOST_POINTS + 1
    assert [trace["x"][0], trace["x"][-1]] == pytest.approx([poses[0, 0], poses[-1, 0]], abs=1e-3)
    assert trace["t_s"][-1] == pytest.approx((n - 1) / 10)
    many = _trace("a_one", run_styles(["a_one", *map(str, range(199))]), poses, stamps_ns)
    assert 200 * len(many["x"]) <= _MOST_POINTS_OF_ALL + 200
    assert many["t_s"][-1] == trace["t_s"][-1]
    segment = inside[1].components[0].graph.segments[0]
    long = replace(
        segment,
        speeds=None,
        stamps_ns=stamps_ns,
        odometry=replace(segment.odometry, distance_m=rng.uniform(0.0, 0.1, n - 1)),
        observations=replace(
            segment.observations.where(rng.integers(0, len(segment.observations), m)),
            keyframe=np.sort(rng.integers(0, n, m)),
        ),
    )
    drawn = timeline(long, rng.uniform(0.0, 4.0, m), [], MOST_TIMES)
    assert len(drawn["t_s"]) <= MOST_TIMES
    assert len(drawn["speed"]["m_s"]) <= MOST_TIMES
    # Merged, before merging and over time, ten times: a tenth of what is allowed.
    assert 10 * len(json.dumps([trace, trace, drawn], separators=(",", ":"))) < 1_500_000


# In a browser.


def test_timeline_and_map_show_the_same_moment(window: Page, made: Path) -> None:
    (component,) = data_of(made / "report.html")["components"]
    window.scheme("light")
    window.open(made / "report.html")
    chosen = "document.getElementById('run')"
    assert window.look(f"[...{chosen}.options].map((each) => each.text)") == ["a_one", "b_one"]
    assert window.look(f"{MAP}.layout.shapes") == []

    def check(run: int, at_s: float) -> None:
        drawn = component["runs"][run]
        place = [np.interp(at_s, drawn["t_s"], drawn[axis]) for axis in "xy"]
        window.wait_for(f"Math.abs({LINE}.layout.shapes.at(-1).x0 - {at_s}) < 0.02")
        window.wait_for(f"{MAP}.layout.shapes.length === 1")
        assert window.look(f"{MAP}.layout.shapes.map((each) => [each.xanchor, each.yanchor])[0]") == pytest.approx(
            place, abs=0.02
        )
        assert window.look(f"{MAP}.layout.shapes[0].fillcolor") == drawn["colour"]
        assert window.look(f"{LINE}.data[0].line.color") == drawn["colour"]
        assert window.look("document.getElementById('moment').textContent").startswith(f"{at_s:.1f} s: 0.")
        assert window.look(f"Number({chosen}.value)") == run

    window.look(
        "(() => { const slider = document.getElementById('time'); slider.value = 3; "
        "slider.dispatchEvent(new Event('input')); })()"
    )
    check(0, 3.0)
    # The mouse over the timeline.
    window.look(f"{LINE}.scrollIntoView({{block: 'center', behavior: 'instant'}})")
    x, y = window.look(
        f"(({{left, top}}) => [left + {LINE}._fullLayout.xaxis._offset + {LINE}._fullLayout.xaxis.d2p(4), top + 100])"
        f"({LINE}.getBoundingClientRect())"
    )
    window.point_at(x, y)
    check(0, 4.0)
    # The other run.
    window.look(f"{chosen}.value = 1; {chosen}.dispatchEvent(new Event('change'))")
    check(1, 0.0)
    # A click at the first run's trajectory.
    drawn = component["runs"][0]
    i = len(drawn["t_s"]) // 3
    window.look(f"{MAP}.scrollIntoView({{block: 'center', behavior: 'instant'}})")
    x, y = window.look(
        f"(({{left, top}}) => [left + {MAP}._fullLayout.xaxis._offset + {MAP}._fullLayout.xaxis.d2p({drawn['x'][i]}), "
        f"top + {MAP}._fullLayout.yaxis._offset + {MAP}._fullLayout.yaxis.d2p({drawn['y'][i]})])"
        f"({MAP}.getBoundingClientRect())"
    )
    window.point_at(x, y)
    window.wait_for(
        "[...document.querySelectorAll('.plot.map .hoverlayer')].some((each) => /a_one at/.test(each.textContent))"
    )
    for kind in ("mousePressed", "mouseReleased"):
        window.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    window.wait_for(f"Number({chosen}.value) === 0")
    check(0, drawn["t_s"][i])
