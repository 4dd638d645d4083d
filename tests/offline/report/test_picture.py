"""map.png shows what the map holds, to scale."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.maps.result import Component, MapResult
from groundsbot.offline.maps.shape import shape_of
from groundsbot.offline.report.label_places import place_labels
from groundsbot.offline.report.picture import draw_map, write_picture
from groundsbot.offline.report.run_styles import run_styles
from tests.support.data.maps import START_B, make_component, make_map, make_run


def texts_of(result: MapResult) -> list[str]:
    return [text.get_text() for axes in draw_map(result).axes for text in axes.texts]


def with_covariance(component: Component, covariance: FloatArray, n_tags: int = 1) -> Component:
    """Some tags with this covariance each, of nothing in common; a single one has no shape."""
    n = 3 * len(component.runs) + 2 * n_tags
    joint = component.joint_covariance[:n, :n].copy()
    joint[-2 * n_tags :, -2 * n_tags :] = np.kron(np.eye(n_tags), covariance)
    tags = tuple(replace(tag, covariance=covariance) for tag in component.tags[:n_tags])
    return replace(component, tags=tags, joint_covariance=joint)


def ellipses_of(figure: Figure) -> list[Ellipse]:
    return [patch for patch in figure.axes[0].patches if isinstance(patch, Ellipse)]


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_file_is_a_picture_1600_pixels_wide_and_always_the_same(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_picture(make_map(), tmp_path / name)
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None
    assert image.shape[1] == 1600
    assert 600 <= image.shape[0] <= 1600
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_fleet_is_drawn_without_ids_and_names_that_would_hide_it() -> None:
    figure = draw_map(fleet(40, 3000))
    assert legend_of(figure)[0] == "40 runs, more than there are colours: see report.html"
    assert not [text for text in legend_of(figure) if text.startswith("r0_")]
    assert not [text for axes in figure.axes for text in axes.texts if text.get_text() == "2999"]
    figure = draw_map(fleet(24, 30))
    assert [text.partition(":")[0] for text in legend_of(figure)[:24]] == [f"r{i}_run" for i in range(24)]
    assert "29" in [text.get_text() for axes in figure.axes for text in axes.texts]


def fleet(n_runs: int, n_tags: int) -> MapResult:
    component = make_component()
    run, tag = component.runs[0], component.tags[0]
    many = replace(
        component,
        runs=tuple(replace(run, name=f"r{i}_run", run=f"r{i}_run") for i in range(n_runs)),
        tags=tuple(replace(tag, tag_id=i, position_m=np.array([i % 50, i / 50.0])) for i in range(n_tags)),
        joint_covariance=np.eye(3 * n_runs + 2 * n_tags),
    )
    return replace(make_map(), components=(many,))


def test_trajectories_starts_and_tags_are_drawn_where_they_are() -> None:
    result = make_map()
    (axes,) = draw_map(result).axes
    drawn = [np.asarray(line.get_xydata()) for line in axes.lines]
    squares = [np.asarray(line.get_xydata()) for line in axes.lines if line.get_marker() == "s"]
    for run in result.runs:
        assert any(data.shape == (20, 2) and np.allclose(data, run.T_map_base[:, :2]) for data in drawn)
        assert any(data.shape == (1, 2) and np.allclose(data[0], run.T_map_start[:2]) for data in drawn)
    for tag in result.components[0].tags:
        assert any(np.isclose(data, tag.position_m).all(axis=1).any() for data in squares)


def test_both_axes_have_the_same_scale() -> None:
    (axes,) = draw_map(make_map()).axes
    one = axes.transData.transform([(0, 0), (1, 0), (0, 1)])
    assert np.linalg.norm(one[1] - one[0]) == pytest.approx(np.linalg.norm(one[2] - one[0]))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x in m", "y in m")


@pytest.mark.parametrize(("sigmas", "factor"), [((0.3, 0.1), 1), ((0.004, 0.001), 10)])
def test_ellipses_hold_95_percent_or_say_how_much_larger_they_are(sigmas: tuple[float, float], factor: int) -> None:
    figure = draw_map(make_map(with_covariance(make_component(), np.diag(sigmas) ** 2)))
    (ellipse,) = ellipses_of(figure)
    said = next(label for label in legend_of(figure) if label.startswith("95 % ellipse, relative to the start of red"))
    half_axes_m = np.array(sigmas) * np.sqrt(chi2.ppf(0.95, 2))
    assert (ellipse.width, ellipse.height) == pytest.approx(2.0 * factor * half_axes_m)
    assert np.cos(np.radians(ellipse.angle)) ** 2 == pytest.approx(1)  # the long axis along x
    assert said.endswith("red_one" if factor == 1 else f"drawn {factor} times its size")


def test_ellipses_are_of_the_shape() -> None:
    component = make_component()
    shape = shape_of(component)
    assert shape is not None
    figure = draw_map(make_map(component))
    assert "95 % ellipse, relative to the other tags" in legend_of(figure)
    for ellipse, covariance in zip(ellipses_of(figure), shape.tag_covariances, strict=True):
        half_axes_m = np.sqrt(chi2.ppf(0.95, 2) * np.linalg.eigvalsh(covariance))
        assert (ellipse.height, ellipse.width) == pytest.approx(2.0 * half_axes_m)


def test_an_ellipse_leans_as_its_covariance_does() -> None:
    covariance = np.array([[0.05, 0.03], [0.03, 0.05]])  # long axis at 45 degrees, variances 0.08 and 0.02
    (ellipse,) = ellipses_of(draw_map(make_map(with_covariance(make_component(), covariance))))
    assert ellipse.angle % 180 == pytest.approx(45)
    assert ellipse.width / ellipse.height == pytest.approx(2)


def test_runs_have_colours_and_shared_tags_another() -> None:
    figure = draw_map(make_map())
    lines = [line for line in figure.axes[0].lines if len(np.asarray(line.get_xydata())) == 20]
    colours = {to_rgb(line.get_color()) for line in lines}
    assert len(colours) == 2
    texts = {text.get_text(): to_rgb(text.get_color()) for text in figure.axes[0].texts}
    assert texts["tag36h11:7"] not in colours
    assert texts["tag25h9:3"] in colours
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "red_one: 1.9 m, 2 tags" in labels
    assert "blue_two: 1.9 m, 3 tags" in labels


def test_two_dozen_runs_look_different() -> None:
    assert len(set(run_styles(f"run_{k}" for k in range(24)).values())) == 24
    figure = draw_map(make_map(*(make_component(f"a_{k}", f"b_{k}") for k in range(6))))
    drawn = [line for axes in figure.axes for line in axes.lines if len(np.asarray(line.get_xydata())) == 20]
    of_legend = [line for line in figure.legends[0].get_lines() if line.get_linestyle() != "None"]
    for lines in (drawn, of_legend):
        assert len(lines) == len({(line.get_color(), line.is_dashed()) for line in lines}) == 12


def test_the_title_has_the_figures() -> None:
    suptitle = draw_map(make_map()).get_suptitle()
    assert "3 tags, 2 runs, 4 m driven" in suptitle
    assert "start to start 10.20 m" in suptitle


def test_ids_are_bare_where_there_is_one_family() -> None:
    component = make_component()
    rows = np.r_[0:10]
    one_family = replace(
        component, tags=component.tags[:2], joint_covariance=component.joint_covariance[np.ix_(rows, rows)]
    )
    assert sorted(texts_of(make_map(one_family))) == ["3", "7"]


def test_components_are_panels_of_their_own() -> None:
    figure = draw_map(make_map(make_component(), make_component("green_one", "grey_two")))
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == [
        "component 1: 3 tags, from the start of red_one",
        "component 2: 3 tags, from the start of green_one",
    ]
    assert "in 2 components" in figure.get_suptitle()
    many = make_map(*(make_component(f"a_{k}", f"b_{k}") for k in range(8)))
    assert len(draw_map(many).axes) == 6
    assert "the 6 largest drawn" in draw_map(many).get_suptitle()


def test_a_run_that_never_moved_and_saw_nothing_can_be_drawn() -> None:
    run = make_run("red_one", np.zeros(3), np.zeros((3, 3)), n=1)
    component = Component("red_one", (run,), (), np.zeros((3, 3)), 0.0, 0)
    figure = draw_map(make_map(component))
    assert "0 tags, 1 run, 0 m driven" in figure.get_suptitle()


def test_stretches_look_alike_and_count_as_one_run() -> None:
    component = make_component()
    stretch = replace(component.runs[1], name="blue_two_stretch2", T_map_start=START_B + np.array([5.0, 0.0, 0.0]))
    joint = np.pad(component.joint_covariance, (0, 3))
    figure = draw_map(make_map(replace(component, runs=(*component.runs, stretch), joint_covariance=joint)))
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "blue_two: 3.8 m, 3 tags, 2 segments" in labels
    assert "2 runs" in figure.get_suptitle()


@given(st.integers(1, 30), st.integers(0, 10_000))
def test_labels_of_points_far_apart_cover_nothing(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.permutation(100)[:n]
    points = np.asarray(np.column_stack([cells % 10, cells // 10]) * 120.0, dtype=np.float64)
    sizes = rng.uniform(10, 30, size=(n, 2))
    centres = place_labels(points, sizes, np.empty((0, 2)))
    for index in range(n):
        others = np.delete(points, index, axis=0)
        assert (np.abs(others - centres[index]) >= sizes[index] / 2).any(axis=1).all()
        assert np.abs(centres[index] - points[index]).max() < 60
    apart = np.abs(centres[:, None] - centres) >= (sizes[:, None] + sizes) / 2
    assert (apart.any(axis=-1) | np.eye(n, dtype=bool)).all()


def test_labels_of_neighbours_keep_clear_of_each_other() -> None:
    points = np.array([[0.0, 0.0], [12.0, 0.0], [6.0, 9.0]])
    sizes = np.tile([20.0, 12.0], (3, 1))
    centres = place_labels(points, sizes, np.empty((0, 2)))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert (np.abs(centres[a] - centres[b]) >= sizes[0]).any()


def test_a_label_covers_no_other_point() -> None:
    points = np.array([[0.0, 0.0], [14.0, 10.0]])  # the second stands where the first's label would go first
    sizes = np.array([[16.0, 10.0], [16.0, 10.0]])
    centres = place_labels(points, sizes, np.empty((0, 2)))
    assert (np.abs(centres[0] - points[1]) >= sizes[0] / 2).any()
    assert (np.abs(centres[1] - points[0]) >= sizes[1] / 2).any()
    assert (centres[0] < points[1]).any()


def test_a_label_stays_in_the_panel() -> None:
    panel = np.array([[0.0, 0.0], [200.0, 100.0]])
    points = np.array([[195.0, 95.0], [5.0, 5.0]])  # two corners, from which only one way is free
    sizes = np.tile([60.0, 12.0], (2, 1))
    centres = place_labels(points, sizes, np.empty((0, 2)), panel)
    assert (centres - sizes / 2 >= panel[0]).all()
    assert (centres + sizes / 2 <= panel[1]).all()
