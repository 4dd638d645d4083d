"""The transform between two maps from the tags they share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib import se2
from calib.arrays import FloatArray
from offline.alignment import INLIER_GATE_M, Alignment, align, fit_transform
from offline.run import TagKey

ANY = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi)).map(np.array)
NEAR_PI = [np.pi, -np.pi, np.pi - 1e-9, -np.pi + 1e-9, 0.0, np.pi / 2]


def places(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-15.0, 15.0, (n, 2))


def named(points: FloatArray, first_id: int = 0) -> dict[TagKey, FloatArray]:
    return {TagKey("tag36h11", first_id + i): point for i, point in enumerate(points)}


def found(tags_a: dict[TagKey, FloatArray], tags_b: dict[TagKey, FloatArray]) -> Alignment:
    alignment = align(tags_a, tags_b)
    assert alignment is not None
    return alignment


def assert_same_transform(a: FloatArray, b: FloatArray, atol: float) -> None:
    np.testing.assert_allclose(se2.log(se2.between(a, b)), np.zeros(3), atol=atol)


@given(ANY, st.integers(0, 1000))
def test_any_transform_is_found(T_a_b: FloatArray, seed: int) -> None:
    b = places(6, seed)
    alignment = found(named(se2.apply(T_a_b, b)), named(b))
    assert_same_transform(alignment.T_a_b, T_a_b, atol=1e-7)
    assert alignment.n_inliers == 6
    assert alignment.rmse_m < 1e-9


@pytest.mark.parametrize("theta", NEAR_PI)
def test_half_a_turn_is_no_special_case(theta: float) -> None:
    T_a_b, b = np.array([3.0, -2.0, theta]), places(8)
    noisy = se2.apply(T_a_b, b) + 0.05 * np.random.default_rng(1).standard_normal(b.shape)
    assert_same_transform(found(named(noisy), named(b)).T_a_b, T_a_b, atol=0.05)


def test_outliers_are_named_and_do_not_bend_the_transform() -> None:
    T_a_b, b = np.array([12.0, 5.0, 2.5]), places(12)
    a = se2.apply(T_a_b, b) + 0.1 * np.random.default_rng(3).standard_normal(b.shape)
    clean = found(named(a[5:]), named(b[5:], 0)).T_a_b
    a[:5] += np.random.default_rng(4).uniform(2.0, 9.0, (5, 2))
    alignment = found(named(a), named(b))
    assert alignment.inlier.tolist() == 5 * [False] + 7 * [True]
    np.testing.assert_allclose(alignment.T_a_b, clean, atol=1e-12)
    left = se2.apply(alignment.T_a_b, b[5:]) - a[5:]
    assert alignment.rmse_m == pytest.approx(np.sqrt((left**2).sum(axis=1).mean()))


def test_only_shared_tags_count() -> None:
    b = places(5)
    T_a_b = np.array([1.0, 2.0, 0.3])
    tags_a = named(se2.apply(T_a_b, b)) | named(places(4, 9), first_id=100)
    alignment = found(tags_a, named(b) | named(places(3, 8), first_id=200))
    assert [tag.tag_id for tag in alignment.shared] == [0, 1, 2, 3, 4]
    assert_same_transform(alignment.T_a_b, T_a_b, atol=1e-9)


def test_one_id_in_two_families_is_two_tags() -> None:
    b = places(3)
    tags_a = named(se2.apply(np.array([1.0, 2.0, 0.3]), b))
    others = {TagKey("tag25h9", key.tag_id): place for key, place in named(b).items()}
    assert align(tags_a, others) is None


def test_two_shared_tags_are_enough() -> None:
    T_a_b, b = np.array([4.0, -3.0, -1.2]), np.array([[0.0, 0.0], [6.0, 1.0]])
    alignment = found(named(se2.apply(T_a_b, b)), named(b))
    assert_same_transform(alignment.T_a_b, T_a_b, atol=1e-9)
    assert alignment.n_inliers == 2


@pytest.mark.parametrize("n", [0, 1])
def test_fewer_than_two_shared_tags_say_nothing(n: int) -> None:
    assert align(named(places(n)), named(places(n))) is None


def test_two_tags_at_another_distance_do_not_fit() -> None:
    b = np.array([[0.0, 0.0], [6.0, 1.0]])
    assert align(named(1.5 * b), named(b)) is None


def test_two_tags_on_one_spot_give_no_heading() -> None:
    b = np.array([[0.0, 0.0], [0.3, 0.0]])
    assert align(named(b), named(b)) is None


def test_the_result_neither_depends_on_the_order_of_tags_nor_on_the_call() -> None:
    T_a_b, b = np.array([7.0, 1.0, 0.4]), places(130)  # more pairs than are tried
    a = se2.apply(T_a_b, b) + 0.2 * np.random.default_rng(3).standard_normal(b.shape)
    a[::4] += 5.0
    first = found(named(a), named(b))
    again = found(dict(reversed(named(a).items())), dict(reversed(named(b).items())))
    np.testing.assert_array_equal(first.T_a_b, again.T_a_b)
    np.testing.assert_array_equal(first.inlier, again.inlier)
    assert first.n_inliers > 90


def test_there_and_back_are_inverse() -> None:
    T_a_b, b = np.array([7.0, 1.0, 3.1]), places(10)
    a = se2.apply(T_a_b, b) + 0.1 * np.random.default_rng(3).standard_normal(b.shape)
    a[:3] -= 4.0
    there, back = found(named(a), named(b)), found(named(b), named(a))
    assert_same_transform(there.T_a_b, se2.inverse(back.T_a_b), atol=1e-9)
    np.testing.assert_array_equal(there.inlier, back.inlier)


def test_inliers_are_those_within_the_gate() -> None:
    b = places(9)
    a = b.copy()
    a[0] += [INLIER_GATE_M * 1.3, 0.0]
    a[1] += [0.0, INLIER_GATE_M * 0.7]
    alignment = found(named(a), named(b))
    assert alignment.inlier.tolist() == [False] + 8 * [True]


@given(ANY, st.integers(0, 1000))
def test_the_fit_is_the_least_of_squares(T_a_b: FloatArray, seed: int) -> None:
    b = places(5, seed)
    a = se2.apply(T_a_b, b) + np.random.default_rng(seed).standard_normal(b.shape)
    best = fit_transform(a, b)

    def cost(T: FloatArray) -> float:
        return float(((se2.apply(T, b) - a) ** 2).sum())

    for step in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
        assert cost(se2.compose(best, se2.exp(step))) > cost(best)
