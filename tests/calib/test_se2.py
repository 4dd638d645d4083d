"""SE(2) on batches, each of which holds angles near zero and near pi."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2

PI = np.pi
# At zero, where series take over from closed forms (0.5), and around half a turn.
ANGLES = np.array([0, 1e-300, 1e-12, 1e-8, 1e-4, 0.5 - 1e-9, 0.5 + 1e-9, PI - 1e-4, PI - 1e-8, PI - 1e-12])
SPECIAL_ANGLES = np.concatenate([ANGLES, -ANGLES, [PI, np.nextafter(PI, 0), -np.nextafter(PI, 0)]])
STEP = 1e-6

batch_shapes = st.sampled_from([(), (1,), (3,), (2, 3)])


@st.composite
def tangents(draw: st.DrawFn, largest: float = 50.0) -> FloatArray:
    """`[*batch, angles, 3]`: the special angles and some drawn ones, with drawn translations."""
    batch = draw(batch_shapes)
    drawn = draw(arrays(np.float64, 4, elements=st.floats(-PI, PI, exclude_min=True)))
    angles = np.concatenate([SPECIAL_ANGLES, drawn])
    out = np.empty((*batch, len(angles), 3))
    out[..., :2] = draw(arrays(np.float64, (*batch, len(angles), 2), elements=st.floats(-largest, largest)))
    out[..., 2] = angles
    return out


def assert_same(left: FloatArray, right: FloatArray, atol: float = 1e-9) -> None:
    """Equal as transforms: headings may differ by whole turns."""
    assert left.shape == right.shape
    np.testing.assert_allclose(left[..., :2], right[..., :2], rtol=0, atol=atol)
    np.testing.assert_allclose(se2.wrap_angle(left[..., 2] - right[..., 2]), 0, rtol=0, atol=atol)


def matrix(T_a_b: FloatArray) -> FloatArray:
    """`[..., 3, 3]` homogeneous matrices."""
    x, y, theta = np.moveaxis(T_a_b, -1, 0)
    cos, sin, zero = np.cos(theta), np.sin(theta), np.zeros_like(theta)
    rows = [cos, -sin, x], [sin, cos, y], [zero, zero, zero + 1.0]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def as_column(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return (matrices @ vectors[..., np.newaxis])[..., 0]


@given(tangents(), tangents())
def test_compose_is_the_product_of_matrices(first: FloatArray, second: FloatArray) -> None:
    second = second[(0,) * (second.ndim - 2)]  # one batch axis, to broadcast against the other
    product = matrix(first) @ matrix(second)
    np.testing.assert_allclose(matrix(se2.compose(first, second)), product, rtol=0, atol=1e-11)


@given(tangents())
def test_inverse_undoes_from_both_sides(transform: FloatArray) -> None:
    assert_same(se2.compose(transform, se2.inverse(transform)), np.zeros_like(transform))
    assert_same(se2.compose(se2.inverse(transform), transform), np.zeros_like(transform))


@given(tangents())
def test_between_leads_from_one_to_the_other(transform: FloatArray) -> None:
    other = transform[..., ::-1, :] * [1, -1, 1]
    assert_same(se2.compose(transform, se2.between(transform, other)), other)
    assert_same(se2.between(transform, other), se2.compose(se2.inverse(transform), other))


@given(tangents())
def test_headings_come_back_in_range(a: FloatArray) -> None:
    b = a[..., ::-1, :]
    for transform in (se2.compose(a, b), se2.between(a, b), se2.inverse(a), se2.exp(a * 5), se2.log(a)):
        assert np.all((transform[..., 2] > -PI) & (transform[..., 2] <= PI))


@given(tangents())
def test_apply_is_the_matrix_and_follows_composition(a: FloatArray) -> None:
    b, points = a[..., ::-1, :], a[..., ::2, :2]
    moved = se2.apply(a[..., ::2, :], points)
    homogeneous = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
    np.testing.assert_allclose(moved, as_column(matrix(a[..., ::2, :]), homogeneous)[..., :2], atol=1e-11)
    point = np.array([1.5, -2.5])
    np.testing.assert_allclose(se2.apply(se2.compose(a, b), point), se2.apply(a, se2.apply(b, point)), atol=1e-9)


@given(tangents())
def test_exp_and_log_undo_each_other(xi: FloatArray) -> None:
    assert_same(se2.exp(se2.log(xi)), xi)
    np.testing.assert_allclose(se2.log(se2.exp(xi)), xi, rtol=0, atol=1e-9)


@given(tangents())
def test_exp_of_a_whole_is_twice_the_half(xi: FloatArray) -> None:
    half = se2.exp(0.5 * xi)
    assert_same(se2.compose(half, half), se2.exp(xi))


@given(tangents())
def test_adjoint_carries_a_twist_across(transform: FloatArray) -> None:
    xi = np.roll(transform, 2, axis=-2) * [0.01, 0.01, 1.0]
    carried = as_column(se2.adjoint(transform), xi)
    assert_same(se2.compose(transform, se2.exp(xi)), se2.compose(se2.exp(carried), transform))


@settings(max_examples=30)
@given(tangents(largest=2.0))
def test_jacobians_of_exp_and_log_agree_with_finite_differences(xi: FloatArray) -> None:
    for axis in range(3):
        step = STEP * np.eye(3)[axis]
        right = (se2.log(se2.between(se2.exp(xi), se2.exp(xi + step)))) / STEP
        np.testing.assert_allclose(right, se2.right_jacobian(xi)[..., axis], atol=2e-5)

    inside = xi[np.abs(xi[..., 2]) < PI - 1e-5]  # log jumps at half a turn
    for axis in range(3):
        step = STEP * np.eye(3)[axis]
        ahead, behind = (se2.log(se2.compose(se2.exp(inside), se2.exp(sign * step))) for sign in (1, -1))
        column = (ahead - behind) / (2 * STEP)
        np.testing.assert_allclose(column, se2.right_jacobian_inverse(inside)[..., axis], atol=1e-6)


@given(tangents())
def test_right_jacobian_inverse_is_the_inverse(xi: FloatArray) -> None:
    product = se2.right_jacobian_inverse(xi) @ se2.right_jacobian(xi)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), rtol=0, atol=1e-11)


def test_right_jacobian_near_zero_by_hand() -> None:
    # To first order in the turn w: [[1, w/2, -y/2 + w x/6], [-w/2, 1, x/2 + w y/6], [0, 0, 1]].
    x, y, turn = 3.0, -7.0, 1e-6
    expected = np.array(
        [[1, turn / 2, -y / 2 + turn * x / 6], [-turn / 2, 1, x / 2 + turn * y / 6], [0, 0, 1]],
    )
    np.testing.assert_allclose(se2.right_jacobian([x, y, turn]), expected, rtol=0, atol=1e-11)


def test_series_and_closed_form_meet() -> None:
    below, above = se2.right_jacobian([[1.0, -2.0, 0.5 - 1e-9], [1.0, -2.0, 0.5 + 1e-9]])
    np.testing.assert_allclose(below, above, rtol=0, atol=5e-9)


@settings(max_examples=30)
@given(tangents(largest=2.0))
def test_right_tangent_from_coordinates_agrees_with_finite_differences(transform: FloatArray) -> None:
    for axis in range(3):
        step = STEP * np.eye(3)[axis]
        column = se2.log(se2.between(transform, transform + step)) / STEP
        np.testing.assert_allclose(column, se2.right_tangent_from_coordinates(transform)[..., axis], atol=2e-6)


@given(arrays(np.float64, 5, elements=st.floats(-1e4, 1e4)))
def test_wrapped_angles_lie_in_range_and_are_the_same_angle(drawn: FloatArray) -> None:
    turns = 2 * PI * np.arange(-3, 4)[:, np.newaxis]
    angles = np.concatenate([(SPECIAL_ANGLES + turns).ravel(), drawn])
    wrapped = se2.wrap_angle(angles)
    assert np.all((wrapped > -PI) & (wrapped <= PI))
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), rtol=0, atol=1e-11)
    np.testing.assert_array_equal(se2.wrap_angle(wrapped), wrapped)


def test_wrap_keeps_what_is_in_range_and_turns_minus_pi_round() -> None:
    np.testing.assert_array_equal(se2.wrap_angle(SPECIAL_ANGLES), SPECIAL_ANGLES)
    assert se2.wrap_angle(-PI) == PI
    assert np.isnan(se2.wrap_angle(np.nan))


@given(tangents(), st.floats(0.0, 1.0))
def test_interpolation_moves_along_one_twist(a: FloatArray, share: float) -> None:
    b = se2.compose(a, np.roll(a, 3, axis=-2) * [1, 1, 0.9])  # short of half a turn, where the way is not unique
    fractions = np.full(a.shape[:-1], share)
    assert_same(se2.interpolate(a, b, 0.0), a)
    assert_same(se2.interpolate(a, b, 1.0), b)
    between = se2.interpolate(a, b, fractions)
    np.testing.assert_allclose(se2.log(se2.between(a, between)), share * se2.log(se2.between(a, b)), atol=1e-8)


@pytest.mark.parametrize("shape", [(0,), (4, 0)])
def test_empty_batches_pass_through(shape: tuple[int, ...]) -> None:
    nothing = np.zeros((*shape, 3))
    assert se2.compose(nothing, nothing).shape == nothing.shape
    assert se2.log(se2.exp(nothing)).shape == nothing.shape
    assert se2.right_jacobian(nothing).shape == (*shape, 3, 3)


def test_a_fit_neither_scales_nor_mirrors() -> None:
    points = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    for changed in (2 * points, points * [1, -1]):
        moved = se2.apply(se2.fit_transform(points, changed), changed)
        assert np.abs(moved - points).max() > 0.1
        assert np.linalg.norm(moved[1] - moved[0]) == pytest.approx(np.linalg.norm(changed[1] - changed[0]))


def test_points_that_coincide_are_fitted_by_their_place() -> None:
    point = np.array([[1.0, 2.0]] * 2)
    np.testing.assert_allclose(se2.apply(se2.fit_transform(point, point + 5), point + 5), point, atol=1e-12)
