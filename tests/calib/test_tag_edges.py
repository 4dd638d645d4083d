"""How corners move when all sides of a tag are seen further out."""

import numpy as np
import pytest

from groundsbot.calib.tags.edges import outward, shift_edges

SQUARE = np.array([[10.0, 20.0], [50.0, 20.0], [50.0, 60.0], [10.0, 60.0]])
SLANTED = np.array([[10.0, 20.0], [42.0, 27.0], [45.0, 51.0], [12.0, 66.0]])


def test_a_square_grows_by_as_much_to_all_sides() -> None:
    np.testing.assert_allclose(outward(SQUARE), [[-1, -1], [1, -1], [1, 1], [-1, 1]], atol=1e-12)


@pytest.mark.parametrize("by_px", [0.3, -0.3])
def test_sides_stay_parallel_and_lie_as_far_out_as_asked(by_px: float) -> None:
    many = np.stack([SQUARE, SLANTED, np.roll(SLANTED, 1, axis=0)])
    moved = shift_edges(many, by_px)
    side, new_side = (np.roll(each, -1, axis=1) - each for each in (many, moved))
    normal = np.stack([side[..., 1], -side[..., 0]], axis=-1) / np.linalg.norm(side, axis=-1, keepdims=True)
    middle = many.mean(axis=1, keepdims=True)
    assert ((normal * (many - middle)).sum(axis=-1) > 0.0).all()
    for corner in (moved, np.roll(moved, -1, axis=1)):
        np.testing.assert_allclose((normal * (corner - many)).sum(axis=-1), by_px)
    np.testing.assert_allclose((normal * new_side).sum(axis=-1), 0.0, atol=1e-12)


def test_corners_that_coincide_do_not_affect_others() -> None:
    moved = shift_edges(np.stack([np.full((4, 2), 7.0), SQUARE]), 0.1)
    assert np.isnan(moved[0]).all()
    np.testing.assert_allclose(moved[1], SQUARE + 0.1 * outward(SQUARE))
