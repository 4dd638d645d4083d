"""The report says what the map says, whatever names are in it, and a browser draws it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.report.accuracy_texts import KeyFigure
from groundsbot.offline.report.cells import length_text
from groundsbot.offline.report.figures import figures
from groundsbot.offline.report.page import Opening, page
from groundsbot.offline.report.report import write_report
from groundsbot.offline.report.sentences import sentences
from groundsbot.offline.report.tables import tables
from groundsbot.offline.report.verdict import doubts
from tests.offline.report.conftest import Inside
from tests.support.browser import Page
from tests.support.data.drives import make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS
from tests.support.report_reader import Read, data_of

pytest.importorskip("plotly", reason="no plotly: `make setup` installs it; without it there is no report")

HOSTILE = "</script><script>window.hacked=1</script><img src=x onerror=window.hacked=1>&amp;\"'$main"


def write_file(inside: Inside, folder: Path) -> Read:
    write_report(*inside, folder / "report.html")
    return Read((folder / "report.html").read_text())


def close(told: str, true: float) -> bool:
    """Whether a figure is the number as rounded where it ends."""
    digits = len(told.partition(".")[2])
    return abs(float(told) - true) <= 0.5001 * 10.0**-digits


def test_figures_in_the_report_are_those_of_the_map(made: Path) -> None:
    document = json.loads((made / "map.json").read_text())
    read = Read((made / "report.html").read_text())
    facts: list[tuple[str, float]] = []
    for row, tag in zip(read.rows("tags"), document["tags"], strict=True):
        covariance = np.array(tag["covariance"])
        assert (row["tag"], row["family"], row["runs"]) == (str(tag["tag_id"]), tag["family"], ", ".join(tag["runs"]))
        facts += zip((row["x (m)"], row["y (m)"]), tag["position_m"], strict=True)
        facts += zip((row["sigma x (m)"], row["sigma y (m)"]), np.sqrt(np.diag(covariance)), strict=True)
        facts += [(row["largest (m)"], np.linalg.eigvalsh(covariance)[-1] ** 0.5)]
        facts += [(row["relative to tags (m)"], np.linalg.eigvalsh(tag["shape_covariance"])[-1] ** 0.5)]
        facts += [(row["observations"], tag["n_observations"])]
    for row, run in zip(read.rows("runs"), document["runs"], strict=True):
        assert (row["run"], row["robot"], row["log"]) == (run["run"], run["robot"], run["log"])
        facts += [(row["keyframes"], run["n_keyframes"]), (row["driven (m)"], run["distance_m"])]
        facts += [(row["heading (deg)"], np.degrees(run["T_map_start"][2]))]
        facts += zip(row["start x, y (m)"].split(", "), run["T_map_start"][:2], strict=True)
    for row, each in zip(read.rows("alignments"), document["alignments"], strict=True):
        fit, _, shared = row["shared tags that fit"].partition(" of ")
        facts += [(fit, each["n_inliers"]), (shared, each["n_shared"]), (row["RMS (m)"], each["inlier_rmse_m"])]
        facts += [(row["yaw (deg)"], np.degrees(each["transform"][2]))]
    for row, each in zip(read.rows("starts"), document["start_to_start"], strict=True):
        facts += [(row["distance (m)"], each["distance_m"]), (row["sigma (m)"], each["sigma_m"])]
    for row, each in zip(read.rows("checks"), document["checks"], strict=True):
        facts += [(row["differ by (%)"], 100.0 * each["value"]), (row["sigmas"], each["sigmas"])]
    for row, each in zip(read.rows("metres"), document["metres"], strict=True):
        facts += [(row["sigma (%)"], 100.0 * each["sigma"]), (row["wheels (%)"], 100.0 * each["shares"]["wheels"])]
    for row, each in zip(read.rows("robots"), document["robot_numbers"], strict=True):
        assert (row["of"], row["number"], row["verdict"]) == (each["owner"], each["what"], each["verdict"])
        facts += [(row["estimate"], each["found"]), (row["sigma"], each["sigma"])]
    assert [row["sigma"] for row in read.rows("noise")] == list(document["noise"])
    assert len(facts) >= 30
    assert [fact for fact in facts if not close(*fact)] == []


def test_the_sentences_are_those_of_the_map(made: Path) -> None:
    document = json.loads((made / "map.json").read_text())
    words = Read((made / "report.html").read_text()).words
    assert 3 <= len(words) <= 6
    assert words == sentences(document)
    driven_m = sum(run["distance_m"] for run in document["runs"])
    assert words[0] == (
        f"2 runs (a_one and b_one; {driven_m:.1f} m driven) were merged into one map of 4 tags, connected by 4 tags "
        "that several of them observed."
    )
    sigmas = [np.linalg.eigvalsh(tag["covariance"])[-1] ** 0.5 for tag in document["tags"]]
    shape = [tag["shape_sigma_m"] for tag in document["tags"]]
    worst = document["tags"][int(np.argmax(shape))]
    heading_deg = np.degrees(document["components"][0]["heading_sigma_rad"])
    (pair,) = document["start_to_start"]
    for part in (
        f"Tags are known to {length_text(np.median(shape))} relative to each other",
        f"the worst, tag {worst['tag_id']}, to {length_text(max(shape))})",
        f"whose heading is uncertain by {heading_deg:.1f} degrees, they are known to {length_text(np.median(sigmas))}",
        f"it is {pair['distance_m']:.2f} m, sigma {100.0 * pair['sigma_m']:.1f} cm",
    ):
        assert part in words[1]
    assert f"known to {100.0 * document['metres'][0]['sigma']:.2f} %" in words[2]


def test_figures_draw_what_the_map_holds(made: Path) -> None:
    document = json.loads((made / "map.json").read_text())
    data = data_of(made / "report.html")
    (component,) = data["components"]
    assert component["is_merged"]
    for drawn, tag in zip(component["tags"], document["tags"], strict=True):
        assert drawn["position_m"] == pytest.approx(tag["position_m"], abs=1e-4)
        (xx, xy), (_, yy) = tag["covariance"]
        assert drawn["covariance"] == pytest.approx([xx, xy, yy], rel=1e-3)
        (xx, xy), (_, yy) = tag["shape_covariance"]
        assert drawn["shape"] == pytest.approx([xx, xy, yy], rel=1e-3)
        assert sum(run["n"] for run in drawn["observations"]) == drawn["n"] == tag["n_observations"]
        assert [run["run"] for run in drawn["observations"]] == tag["runs"]
        assert all(0.1 < run["rms"] <= run["worst"] + 0.1 < 6.0 for run in drawn["observations"])
    # Residuals are scaled so that their root mean square over the map is 1.
    residuals = [(run["n"], run["rms"]) for tag in component["tags"] for run in tag["observations"]]
    n, rms = np.array(residuals).T
    assert np.average(rms**2, weights=n) == pytest.approx(1.0, abs=0.02)
    for drawn, run in zip(component["runs"], document["runs"], strict=True):
        assert [drawn["x"][0], drawn["y"][0]] == pytest.approx(run["T_map_start"][:2], abs=1e-3)
    before = component["before"]
    assert [layer["run"] for layer in before] == ["a_one", "b_one"]
    apart = np.hypot(*(np.subtract(before[0]["tags"][axis], before[1]["tags"][axis]) for axis in "xy"))
    assert apart.max() < 0.5  # the alignment lays them over each other


def test_no_name_can_become_a_script(inside: Inside, folder: Path) -> None:
    result, workings = inside
    document = json.loads(json.dumps(map_as_json(result)).replace("a_one", "HOSTILE").replace("tag36h11", "HOSTILE"))
    document = json.loads(json.dumps(document).replace("HOSTILE", json.dumps(HOSTILE)[1:-1]))
    document["suspect_tags"] = [
        {"tag_id": 3, "family": HOSTILE, "kind": HOSTILE, "runs": [HOSTILE], "evidence": HOSTILE}
        | {"has_ordered_places": True}
    ]
    drawn = json.loads(json.dumps(figures(map_as_json(result), workings)).replace("a_one", json.dumps(HOSTILE)[1:-1]))
    drawn["components"][0]["runs"][0]["dashes"] = [5.0, 2.0]
    opening = Opening(HOSTILE, HOSTILE, 1, HOSTILE, [KeyFigure(HOSTILE, HOSTILE, HOSTILE)], doubts(document))
    text = page(opening, [HOSTILE, *sentences(document)], [HOSTILE], tables(document), drawn)
    read = Read(text)
    assert [tag for tag, _ in read.elements].count("script") == 3
    assert all(tag != "img" and "onerror" not in attributes for tag, attributes in read.elements)
    assert read.words[0] == HOSTILE
    assert read.rows("suspects")[0]["evidence"] == HOSTILE
    assert f"{HOSTILE} and b_one" in read.words[1]
    (folder / "hostile.html").write_text(text)
    assert data_of(folder / "hostile.html")["components"][0]["runs"][0]["run"] == HOSTILE


def test_nothing_is_fetched(made: Path) -> None:
    text = (made / "report.html").read_text()
    read = Read(text)
    for tag, attributes in read.elements:
        assert "src" not in attributes, tag
        assert (attributes.get("href") or "data:,").startswith(("data:", "#"))
    policy = next(attributes for tag, attributes in read.elements if "http-equiv" in attributes)
    assert "default-src 'none'" in (policy["content"] or "")


def test_a_single_run(logs: list[Path], tmp_path: Path) -> None:
    workings = Diagnostics()
    read = write_file((build_map(read_runs(logs[:1]), workings=workings), workings), tmp_path)
    assert read.words[0].startswith("One run, a_one, drove ")
    assert read.words[0].endswith("nothing was merged.")
    assert "before" not in {attributes.get("id") for _, attributes in read.elements}
    assert "holding" not in read.tables
    assert len(read.rows("tags")) == 4


def test_a_run_without_tags(tmp_path: Path) -> None:
    log = write_drive(tmp_path / "logs", DRIVES["a"], [], make_robot("a"))
    workings = Diagnostics()
    read = write_file((build_map(read_runs([log]), workings=workings), workings), tmp_path)
    assert "It has no tags, so nothing corrects the wheels' odometry." in read.words
    assert data_of(tmp_path / "report.html")["components"][0]["tags"] == []


def test_several_components(logs: list[Path], tmp_path: Path) -> None:
    far = [replace(tag, tag_id=tag.tag_id + 50) for tag in TAGS]
    alone = write_drive(tmp_path / "logs", DRIVES["a"], far, make_robot("c"))
    workings = Diagnostics()
    read = write_file((build_map(read_runs([*logs, alone]), workings=workings), workings), tmp_path)
    assert "3 runs" in read.words[0]
    assert "there are 2 components" in read.words[0]
    assert "the largest has 2 runs and 4 tags" in read.words[0]
    assert read.words[-1].startswith("To join the components, drive one more run past two or more tags of each")
    assert [row["component"] for row in read.rows("runs")] == ["1", "1", "2"]
    plots = [attributes["class"] for _, attributes in read.elements if "plot" in (attributes.get("class") or "")]
    assert plots == ["plot map"] * 2 + ["plot timeline", "plot before"]


# Size.


def test_the_report_is_small(made: Path) -> None:
    from plotly.offline import get_plotlyjs

    assert len((made / "report.html").read_bytes()) - len(get_plotlyjs().encode()) < 200_000


# In a browser.


# Where a tag of the first map is on the screen.
SPOT = """(() => {
  const plot = document.querySelector(".plot.map"), layout = plot._fullLayout;
  const trace = plot.data.find((each) => (each.name || "").startsWith("tags")), box = plot.getBoundingClientRect();
  return [box.left + layout.xaxis._offset + layout.xaxis.d2p(trace.x[0]),
    box.top + layout.yaxis._offset + layout.yaxis.d2p(trace.y[0])];
})()"""
HOVERED = "[...document.querySelectorAll('.plot.map .hoverlayer')].map((each) => each.textContent).join('')"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_draws_it_and_answers(window: Page, made: Path, scheme: str) -> None:
    document = json.loads((made / "map.json").read_text())
    window.complaints.clear()
    window.requests.clear()
    window.scheme(scheme)
    window.open(made / "report.html")
    assert window.look("document.querySelectorAll('.plot').length") == 3
    assert window.look("document.querySelectorAll('.plot .main-svg .trace').length") > 12
    back = window.look("getComputedStyle(document.body).backgroundColor")
    assert back == ("rgb(255, 255, 255)" if scheme == "light" else "rgb(21, 24, 27)")
    words = "[...document.querySelectorAll('.plot .legendtext, .plot .xtick text')].map((each) => each.style.fill)"
    assert set(window.look(words)) == {"rgb(29, 33, 37)" if scheme == "light" else "rgb(230, 233, 236)"}
    # The largest sigma stands out most from the background.
    assert window.look(f"{PLOT}._fullLayout.coloraxis.reversescale") == (scheme == "light")
    window.look("document.querySelector('.plot.map').scrollIntoView({block: 'center', behavior: 'instant'})")
    x, y = window.look(SPOT)
    window.point_at(x, y)
    window.wait_for(f"{HOVERED}.includes('tag')")
    tag = document["tags"][0]
    assert f"tag {tag['tag_id']} (tag36h11)" in window.look(HOVERED)
    assert f"x {tag['position_m'][0]:.3f} m" in window.look(HOVERED)
    assert f"read {tag['n_observations']} times" in window.look(HOVERED)
    for name, frame in (("shape_covariance", "the other tags"), ("covariance", "the start of a_one")):
        sigma_x_m, sigma_y_m = np.sqrt(np.diag(tag[name]))
        told = f"sigma x {sigma_x_m:.3f} m, y {sigma_y_m:.3f} m relative to {frame}"
        assert told in window.look(HOVERED)
    before = window.look(WIDE)
    window.turn_wheel(x, y, -300.0)
    window.wait_for(f"{WIDE} < {0.95 * before}")
    window.look("document.querySelector('button[data-value=apart]').click()")
    assert window.look("document.querySelector('button[data-value=apart]').ariaPressed") == "true"
    window.scheme("dark" if scheme == "light" else "light")
    window.wait_for(f"{PLOT}._fullLayout.coloraxis.reversescale === {json.dumps(scheme == 'dark')}")
    assert window.complaints == []
    assert all(request.startswith(("file:", "data:", "blob:")) for request in window.requests)


PLOT = "document.querySelector('.plot.map')"
ELLIPSES = "document.querySelector('.plot.map').data.find((each) => each.name.startsWith('95 %'))"
WIDE = "(([low, high]) => high - low)(document.querySelector('.plot.map')._fullLayout.xaxis.range)"


def test_buttons_switch_sigmas_between_shape_and_frame_and_colours_to_the_runs(window: Page, made: Path) -> None:
    document = json.loads((made / "map.json").read_text())
    window.scheme("light")
    window.open(made / "report.html")
    colours = f"{PLOT}.data.find((each) => each.name === 'tags of several runs').marker.color"

    def check(name: str, covariance: list[list[float]]) -> None:
        assert window.look(f"{ELLIPSES}.name") == f"95 % ellipses, relative to {name}"
        sigmas_m = [tag["shape_sigma_m" if "tags" in name else "sigma_m"] for tag in document["tags"]]
        assert window.look(colours) == pytest.approx(np.log10(sigmas_m), abs=1e-4)
        assert "sigma (m)" in window.look("document.querySelector('.plot.map .cbtitle').textContent")
        ticks = window.look("[...document.querySelectorAll('.plot.map .cbaxis text')].map((each) => each.textContent)")
        assert ticks[0].endswith(" worst")
        assert float(ticks[0].removesuffix(" worst")) == pytest.approx(max(sigmas_m), rel=0.05)
        x, y = (np.array(window.look(f"{ELLIPSES}.{axis}.slice(0, 37)")) for axis in "xy")
        # Along their worst directions, from the first tag.
        away = np.column_stack([x, y]) - document["tags"][0]["position_m"]
        values, vectors = np.linalg.eigh(covariance)
        assert np.abs(away @ vectors[:, 1]).max() == pytest.approx(np.sqrt(5.9915 * values[1]), rel=0.01)

    first = document["tags"][0]
    check("the other tags", first["shape_covariance"])
    window.look("document.querySelector('.plot.map').scrollIntoView({block: 'center', behavior: 'instant'})")
    x, y = window.look(SPOT)
    before = window.look(WIDE)
    # A while after the wheel's last turn plotly takes the zoom over.
    window.look("void document.querySelector('.plot.map').once('plotly_relayout', () => { window.isZoomed = true; })")
    window.turn_wheel(x, y, -300.0)
    window.wait_for("window.isZoomed")
    zoomed = window.look(WIDE)
    assert zoomed < 0.95 * before
    window.look(
        "new Promise((resolve) => { document.querySelector('.plot.map').once('plotly_afterplot', () => resolve(true));"
        "document.querySelector('button[data-value=frame]').click(); })"
    )
    check("the frame", first["covariance"])
    frame = "document.querySelector('button[data-value=frame]').textContent"
    assert window.look(frame) == "relative to the start of a_one"
    pressed = "[...document.querySelectorAll('button[data-choice=ellipses]')].map((each) => each.ariaPressed)"
    assert window.look(pressed) == ["false", "true"]
    assert window.look(WIDE) == pytest.approx(zoomed, rel=0.01)  # the scale's numbers are as wide as they are
    window.look("document.querySelector('button[data-value=shape]').click()")
    check("the other tags", first["shape_covariance"])
    window.look("document.querySelector('button[data-value=run]').click()")
    assert window.look(colours) == "#222222"
    assert window.look("document.querySelectorAll('.plot.map .cbtitle').length") == 0


def test_a_browser_runs_no_name(window: Page, inside: Inside, folder: Path) -> None:
    test_no_name_can_become_a_script(inside, folder)
    window.open(folder / "hostile.html")
    assert window.look("window.hacked === undefined")
    legend = window.look("document.querySelector('.plot.map .legend').textContent")
    assert "window.hacked=1</script>" in legend  # as text
    assert window.look(f"{PLOT}.data.find((each) => each.name.includes('hacked')).line.dash") == "8px,3.2px"


def test_it_prints(window: Page, made: Path) -> None:
    import pypdfium2

    window.scheme("dark")
    window.open(made / "report.html", wide=700)
    window.look("window.dispatchEvent(new Event('beforeprint'))")
    assert window.look("document.querySelector('.plot.map .legendtext').style.fill") == "rgb(0, 0, 0)"
    window.look("window.dispatchEvent(new Event('afterprint'))")
    printed = pypdfium2.PdfDocument(window.pdf())
    text = "".join(printed[i].get_textpage().get_text_range() for i in range(len(printed)))
    assert 2 <= len(printed) <= 8
    for part in ("one map of 4 tags", "Before merging", "Robot parameters estimated"):
        assert part in " ".join(text.split())


def test_figures_follow_the_window_and_overlap_nothing(window: Page, made: Path) -> None:
    window.open(made / "report.html", wide=1200)
    window.call("Emulation.setDeviceMetricsOverride", width=800, height=2500, deviceScaleFactor=1, mobile=False)
    drawn = "[...document.querySelectorAll('.plot')].map((each) => [each, each.querySelector('.main-svg')])"
    window.wait_for(f"{drawn}.every(([each, svg]) => svg.clientWidth === each.clientWidth && svg.clientWidth < 800)")
    assert window.look(f"{drawn}.every(([each, svg]) => svg.clientHeight <= each.clientHeight)")


def test_advice_that_nothing_helps_stands_once(inside: Inside) -> None:
    document = map_as_json(inside[0])
    document["advice"] = [each | {"sigma_then_m": each["sigma_m"]} for each in document["advice"]] * 2
    assert len(document["advice"]) > 1
    table = next(each for each in tables(document) if each.key == "advice")
    assert len(table.rows) == 1
