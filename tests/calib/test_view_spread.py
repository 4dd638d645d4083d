"""What views of a board cover and still miss, from their corners alone."""

import numpy as np
import pytest

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.board.view_spread import Coverage, SeenBoard, describe_board
from groundsbot.fixtures.pictures.board_picture import View
from tests.support.board_views import PLAIN, hold_board, project

SIZE_PX = (PLAIN.width_px, PLAIN.height_px)


def observe_view(view: View) -> SeenBoard:
    pixels = project(view)
    inside = ((pixels > -0.5) & (pixels < np.array(SIZE_PX) - 0.5)).all(axis=1)
    found = describe_board(np.flatnonzero(inside), pixels[inside], DEFAULT_BOARD, SIZE_PX)
    assert found is not None
    return found


@pytest.mark.parametrize(("right_deg", "lower_deg"), [(0, 0), (30, 0), (-30, 0), (0, 25), (0, -40), (60, 0)])
@pytest.mark.parametrize("share", [0.3, 0.6])
def test_tilt_and_size_of_a_board_in_the_middle(right_deg: float, lower_deg: float, share: float) -> None:
    found = observe_view(hold_board(share=share, right_deg=right_deg, lower_deg=lower_deg))
    np.testing.assert_allclose(found.tilt_deg, [right_deg, lower_deg], atol=1.0)
    assert found.share == pytest.approx(share, rel=0.01)


def test_a_board_parallel_to_the_picture_is_not_tilted_wherever_it_is() -> None:
    for at in ((0.2, 0.2), (0.8, 0.5), (0.4, 0.9)):
        assert np.hypot(*observe_view(hold_board(at)).tilt_deg) < 1.0


def test_corners_without_information() -> None:
    pixels = project(hold_board())
    row, column = np.arange(6), np.arange(0, 48, 6)
    for ids in (np.arange(0), np.array([0, 1, 6, 7, 8]), row, column):
        assert describe_board(ids, pixels[ids], DEFAULT_BOARD, SIZE_PX) is None
    assert describe_board(np.array([0, 1, 2, 6, 7, 8]), pixels[[0, 1, 2, 6, 7, 8]], DEFAULT_BOARD, SIZE_PX) is not None


def test_regions_are_those_that_corners_lie_in() -> None:
    assert observe_view(hold_board((0.5, 0.5), 0.25)).regions == {(1, 1)}
    assert observe_view(hold_board((0.2, 0.2), 0.25)).regions == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert observe_view(hold_board((0.83, 0.5), 0.25)).regions == {(1, 1), (1, 2)}


def test_missing_views_are_reported_until_they_are_there() -> None:
    spread = Coverage()
    everything = ["show", "tilt the board, its left, right, upper, lower side", "nearer", "farther away"]
    assert all(said in text for said, text in zip(everything, spread.missing(), strict=True))
    assert spread.missing()[0].endswith(
        "top left, top, top right, left, middle, right, bottom left, bottom, bottom right"
    )

    for _ in range(2):  # one view of each may turn out to be of no use
        assert "left, right, upper, lower" in spread.missing()[1]
        spread.add(observe_view(hold_board((0.2, 0.2), 0.3, right_deg=30.0)))
    where, tilts, nearer = spread.missing()
    assert where == "show the board at the picture's top right, right, bottom left, bottom, bottom right"
    assert tilts == "tilt the board, its left, upper, lower side nearer to the camera"
    assert nearer == "bring the board nearer"

    for view in [hold_board((0.8, 0.2), 0.3, lower_deg=-30.0), hold_board((0.8, 0.8), 0.3, right_deg=-30.0)] * 2:
        spread.add(observe_view(view))
    assert spread.missing() == [
        "show the board at the picture's bottom left",
        "tilt the board, its lower side nearer to the camera",
        "bring the board nearer",
    ]
    for view in [hold_board((0.2, 0.8), 0.3, lower_deg=30.0), hold_board(share=0.6)] * 2:
        spread.add(observe_view(view))
    assert spread.missing() == []
