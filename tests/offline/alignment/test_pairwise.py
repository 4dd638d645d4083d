"""The transform between two maps from the tags they share, and when it is accepted."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.geometry.se2 import fit_transform
from groundsbot.offline.alignment.condensed_map import CondensedMap
from groundsbot.offline.alignment.model_selection import MARGIN_NATS
from groundsbot.offline.alignment.pairwise import Alignment, align, covariance_union
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.measurements.tape import Placement

ANY = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi)).map(np.array)
NEAR_PI = [np.pi, -np.pi, np.pi - 1e-9, -np.pi + 1e-9, 0.0, np.pi / 2]
SIGMA_M = 0.05


def places(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-15.0, 15.0, (n, 2))


def name_points(points: FloatArray, first_id: int = 0) -> dict[TagKey, FloatArray]:
    return {TagKey("tag36h11", first_id + i): point for i, point in enumerate(points)}


def observe(tags: Mapping[TagKey, FloatArray], name: str = "a", sigma_m: float = SIGMA_M) -> CondensedMap:
    """A map whose tags were all read from its start, each with the same noise."""
    n = len(tags)
    keys = tuple(sorted(tags))
    covariance = np.zeros((5 * n, 5 * n))
    covariance[3 * n :, 3 * n :] = sigma_m**2 * np.eye(2 * n)
    return CondensedMap(
        name, keys, np.zeros((n, 3)), np.array([tags[key] for key in keys]).reshape(-1, 2), covariance, 0
    )


def align_points(tags_a: Mapping[TagKey, FloatArray], tags_b: Mapping[TagKey, FloatArray]) -> Alignment:
    alignment = align(observe(tags_a), observe(tags_b, "b"))
    assert alignment is not None
    return alignment


def assert_same_transform(a: FloatArray, b: FloatArray, atol: float) -> None:
    np.testing.assert_allclose(se2.log(se2.between(a, b)), np.zeros(3), atol=atol)


@settings(deadline=None, max_examples=30)
@given(ANY, st.integers(0, 1000))
def test_any_transform_is_found(T_a_b: FloatArray, seed: int) -> None:
    b = places(6, seed)
    alignment = align_points(name_points(se2.apply(T_a_b, b)), name_points(b))
    assert_same_transform(alignment.T_a_b, T_a_b, atol=1e-7)
    assert alignment.n_inliers == 6
    assert alignment.is_accepted
    assert alignment.rmse_m < 1e-9
    assert alignment.cost_increase < 1e-9


@pytest.mark.parametrize("theta", NEAR_PI)
def test_half_a_turn_is_no_special_case(theta: float) -> None:
    T_a_b, b = np.array([3.0, -2.0, theta]), places(8)
    noisy = se2.apply(T_a_b, b) + 0.05 * np.random.default_rng(1).standard_normal(b.shape)
    assert_same_transform(align_points(name_points(noisy), name_points(b)).T_a_b, T_a_b, atol=0.05)


def test_outliers_are_named_and_do_not_change_the_transform() -> None:
    T_a_b, b = np.array([12.0, 5.0, 2.5]), places(12)
    a = se2.apply(T_a_b, b) + 0.05 * np.random.default_rng(3).standard_normal(b.shape)
    clean = align_points(name_points(a[5:]), name_points(b[5:], 0)).T_a_b
    shift = np.random.default_rng(4).uniform(2.0, 9.0, (5, 2))
    a[:5] += shift
    alignment = align_points(name_points(a), name_points(b))
    assert alignment.is_accepted
    assert alignment.inlier.tolist() == 5 * [False] + 7 * [True]
    np.testing.assert_allclose(alignment.T_a_b, clean, atol=1e-9)
    np.testing.assert_allclose(alignment.off_m[:5], np.linalg.norm(shift, axis=1), atol=0.3)
    assert (alignment.off_sigmas[:5] > 15.0).all()
    left = se2.apply(alignment.T_a_b, b[5:]) - a[5:]
    assert alignment.rmse_m == pytest.approx(np.sqrt((left**2).sum(axis=1).mean()))


def test_only_shared_tags_count() -> None:
    b = places(5)
    T_a_b = np.array([1.0, 2.0, 0.3])
    tags_a = name_points(se2.apply(T_a_b, b)) | name_points(places(4, 9), first_id=100)
    alignment = align_points(tags_a, name_points(b) | name_points(places(3, 8), first_id=200))
    assert [tag.tag_id for tag in alignment.shared] == [0, 1, 2, 3, 4]
    assert_same_transform(alignment.T_a_b, T_a_b, atol=1e-9)


def test_one_id_in_two_families_is_two_tags() -> None:
    b = places(3)
    tags_a = name_points(se2.apply(np.array([1.0, 2.0, 0.3]), b))
    others = {TagKey("tag25h9", key.tag_id): place for key, place in name_points(b).items()}
    assert align(observe(tags_a), observe(others)) is None


def test_two_shared_tags_are_enough_where_no_other_contradicts() -> None:
    T_a_b, b = np.array([4.0, -3.0, -1.2]), np.array([[0.0, 0.0], [6.0, 1.0]])
    alignment = align_points(name_points(se2.apply(T_a_b, b)), name_points(b))
    assert_same_transform(alignment.T_a_b, T_a_b, atol=1e-9)
    assert alignment.n_inliers == 2
    assert alignment.is_accepted


def test_two_that_fit_among_others_that_do_not_may_be_chance() -> None:
    b = np.array([[0.0, 0.0], [6.0, 1.0], [3.0, 9.0], [-5.0, 4.0]])
    a = b + np.array([[0.0, 0.0], [0.0, 0.0], [7.0, 3.0], [-2.0, -6.0]])
    alignment = align_points(name_points(a), name_points(b))
    assert alignment.inlier.tolist() == [True, True, False, False]
    assert not alignment.is_accepted


@pytest.mark.parametrize("n", [0, 1])
def test_fewer_than_two_shared_tags_say_nothing(n: int) -> None:
    other = name_points(places(2), first_id=50)
    assert align(observe(name_points(places(n)) | other), observe(name_points(places(n)))) is None


def test_two_tags_at_another_distance_do_not_fit() -> None:
    b = np.array([[0.0, 0.0], [6.0, 1.0]])
    assert align(observe(name_points(1.5 * b)), observe(name_points(b))) is None


def test_two_tags_on_one_spot_give_no_heading() -> None:
    b = np.array([[0.0, 0.0], [0.3, 0.0]])
    assert align(observe(name_points(b)), observe(name_points(b))) is None


def test_the_result_neither_depends_on_the_order_of_tags_nor_on_the_call() -> None:
    T_a_b, b = np.array([7.0, 1.0, 0.4]), places(60)
    a = se2.apply(T_a_b, b) + 0.05 * np.random.default_rng(3).standard_normal(b.shape)
    a[::4] += 5.0 * np.random.default_rng(4).standard_normal(a[::4].shape)
    first = align_points(name_points(a), name_points(b))
    again = align_points(dict(reversed(name_points(a).items())), dict(reversed(name_points(b).items())))
    np.testing.assert_array_equal(first.T_a_b, again.T_a_b)
    np.testing.assert_array_equal(first.inlier, again.inlier)
    assert first.n_inliers > 43


def test_there_and_back_are_inverse() -> None:
    T_a_b, b = np.array([7.0, 1.0, 3.1]), places(10)
    # What differs is of second order in the noise: other choices of tags are weighed about where all put map b.
    a = se2.apply(T_a_b, b) + 0.001 * np.random.default_rng(3).standard_normal(b.shape)
    a[:3] -= 4.0 * np.array([[1.0, 0.5], [-0.3, 1.0], [1.0, -1.0]])
    there, back = align_points(name_points(a), name_points(b)), align_points(name_points(b), name_points(a))
    assert_same_transform(there.T_a_b, se2.inverse(back.T_a_b), atol=1e-6)
    np.testing.assert_array_equal(there.inlier, back.inlier)
    turned = se2.adjoint(there.T_a_b)
    np.testing.assert_allclose(turned @ there.covariance @ turned.T, back.covariance, rtol=1e-3, atol=1e-9)


def test_a_symmetric_layout_is_ambiguous() -> None:
    """Half of the tags say one thing and half of them another, as where labels were swapped across a room."""
    b = places(4)
    b = np.concatenate([b, -b])
    a = b.copy()
    a[[0, 1, 4, 5]] *= -1.0
    alignment = align_points(name_points(a), name_points(b))
    assert not alignment.is_accepted
    (rival,) = alignment.alternatives
    stayed = (a == b).all(axis=1)
    assert {tuple(alignment.inlier), tuple(rival.inlier)} == {tuple(stayed), tuple(~stayed)}


def test_a_loose_group_is_an_alternative_where_the_others_may_have_moved_as_one() -> None:
    """Five tags known to 5 cm say one thing, and four that are known to 0.4 m another: these alone prove nothing."""
    near = np.array([[0.0, 0.0], [3.0, 0.5], [1.0, 4.0], [5.0, 3.0], [-2.0, 2.0]])
    far = np.array([[9.0, -3.0], [12.0, 1.0], [10.0, 5.0], [13.0, -4.0]])
    moved = np.concatenate([se2.apply([2.0, -3.0, 0.3], near), far])

    def loose(points: FloatArray, name: str) -> CondensedMap:
        tight = observe(name_points(points), name)
        covariance = tight.covariance.copy()
        covariance[-8:, -8:] = 0.4**2 * np.eye(8)
        return replace(tight, covariance=covariance)

    alignment = align(loose(moved, "a"), loose(np.concatenate([near, far]), "b"))
    assert alignment is not None
    assert not alignment.is_accepted
    (rival,) = alignment.alternatives
    assert alignment.log_bayes_factor > rival.log_bayes_factor + MARGIN_NATS
    assert rival.inlier.tolist() == 5 * [False] + 4 * [True]


def test_a_corridor_with_a_pattern_that_repeats_and_ids_put_up_anew_is_ambiguous() -> None:
    """Door posts every 4 m on both sides; every other tag was put up again one pair of doors further."""
    b = np.array([[4.0 * door, side] for door in range(7) for side in (-1.0, 1.0)])
    a = b + np.where(np.arange(14)[:, None] % 4 < 2, [4.0, 0.0], [0.0, 0.0])
    alignment = align_points(name_points(a), name_points(b))
    assert not alignment.is_accepted
    ways = [alignment.T_a_b, *(rival.T_a_b for rival in alignment.alternatives)]
    for shift_m in (0.0, 4.0):
        assert min(np.abs(way - [shift_m, 0.0, 0.0]).max() for way in ways) < 1e-6


def test_a_measured_start_resolves_an_ambiguous_alignment() -> None:
    b = np.array([[4.0 * door, side] for door in range(7) for side in (-1.0, 1.0)])
    a = b + np.where(np.arange(14)[:, None] % 4 < 2, [4.0, 0.0], [0.0, 0.0])
    for shift_m in (0.0, 4.0):
        measured = Placement(np.array([shift_m + 0.1, 0.05, 0.02]), np.diag([0.1, 0.1, 0.03]) ** 2)
        alignment = align(observe(name_points(a)), observe(name_points(b), "b"), measured)
        assert alignment is not None
        assert alignment.is_accepted
        assert_same_transform(alignment.T_a_b, np.array([shift_m, 0.0, 0.0]), atol=1e-6)


def two_moved_as_one(shift_m: float) -> Alignment:
    """Five tags in one corner, which predict two far ones to 1.3 m; these two moved sideways together."""
    b = np.array([[0.0, 0.0], [3.0, 1.0], [-1.0, 3.0], [2.0, -3.0], [-3.0, -1.0], [15.0, 0.0], [16.0, 2.0]])
    a = b.copy()
    a[5:] += [0.0, shift_m]
    alignment = align(observe(name_points(a), sigma_m=0.4), observe(name_points(b), "b", sigma_m=0.4))
    assert alignment is not None
    return alignment


def test_two_wrong_tags_that_agree_make_the_alignment_ambiguous() -> None:
    """Either alone is held by the other; only without both would the rest have map b elsewhere."""
    alignment = two_moved_as_one(5.0)
    assert alignment.n_inliers == 7
    off = se2.log(alignment.T_a_b)
    assert float(off @ np.linalg.solve(alignment.covariance, off)) < chi2.isf(1e-4, 3)
    assert alignment.covariance[2, 2] > 9.0 * two_moved_as_one(0.0).covariance[2, 2]


def test_groups_that_do_not_predict_each_other_are_tried_together() -> None:
    """A corridor 40 m long that map a has bent, three tags at each end and two wrong ones near the first."""
    near = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0], [5.0, 9.0], [8.0, -7.0]])
    far = np.array([[0.0, 0.0], [3.0, 1.0], [1.0, 4.0]])
    n_near, n_far = len(near), len(far)
    straight = observe(name_points(np.concatenate([near, far])), "b")
    T_start_far = np.array([40.0, 0.0, 0.0])
    b = replace(straight, T_start_anchor=np.concatenate([np.zeros((n_near, 3)), np.tile(T_start_far, (n_far, 1))]))
    bend = np.array([6.0, -9.0, 0.6])
    moved = near + np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [3.0, 2.0], [-4.0, 1.0]])
    # What lies at the far end was read from poses there, which err together.
    at_far_end = np.repeat([0.0, 1.0], [n_near, n_far])
    covariance = b.covariance.copy()
    n_poses = 3 * (n_near + n_far)
    covariance[:n_poses, :n_poses] += np.kron(np.outer(at_far_end, at_far_end), np.diag([6.0, 6.0, 0.4]) ** 2)
    a = replace(
        b,
        name="a",
        T_start_anchor=se2.compose(b.T_start_anchor, np.outer(at_far_end, bend)),
        tag_m=np.concatenate([moved, far]),
        covariance=covariance,
    )
    alignment, by_near_end = align(a, b), align(observe(name_points(moved)), observe(name_points(near), "b"))
    assert alignment is not None
    assert by_near_end is not None
    assert alignment.log_bayes_factor > by_near_end.log_bayes_factor + MARGIN_NATS


def test_a_loosely_connected_part_may_have_moved_as_one() -> None:
    """Two rooms that the drives place to 2 m; one room was moved by 5.5 m, which a bend explains."""
    one = np.array([[0.0, 0.0], [3.0, 1.0], [-1.0, 3.0], [2.0, -3.0], [-3.0, -1.0]])
    other = np.array([[0.0, 0.0], [3.0, 1.0], [1.0, 4.0], [-2.0, 2.0]])
    straight = observe(name_points(np.concatenate([one, other])), "b")
    in_other = np.repeat([0.0, 1.0], [len(one), len(other)])
    T_start_other = np.array([12.0, 0.0, 0.0])
    covariance = straight.covariance.copy()
    n_poses = 3 * len(in_other)
    covariance[:n_poses, :n_poses] += np.kron(np.outer(in_other, in_other), np.diag([1.4, 1.4, 0.1]) ** 2)
    b = replace(straight, T_start_anchor=np.outer(in_other, T_start_other), covariance=covariance)
    a = replace(b, name="a", T_start_anchor=b.T_start_anchor + np.outer(in_other, [0.0, 5.5, 0.0]))
    alignment = align(a, b)
    assert alignment is not None
    assert alignment.n_inliers == len(in_other)
    for T_a_b in (np.zeros(3), np.array([0.0, 5.5, 0.0])):
        off = se2.log(se2.between(T_a_b, alignment.T_a_b))
        assert float(off @ np.linalg.solve(alignment.covariance, off)) < chi2.isf(1e-4, 3)


@given(st.integers(0, 1000))
def test_a_union_is_no_less_than_either_and_no_more_than_need_be(seed: int) -> None:
    roots = np.random.default_rng(seed).standard_normal((2, 3, 3))
    one, other = (root @ root.T + 0.1 * np.eye(3) for root in roots)
    union = covariance_union(one, other)
    rounding = 1e-9 * np.trace(union)
    assert all(np.linalg.eigvalsh(union - each)[0] > -rounding for each in (one, other))
    # Along each of the common axes it is one or the other.
    np.testing.assert_allclose((union - one) @ np.linalg.solve(union, union - other), 0.0, atol=rounding)
    np.testing.assert_allclose(union, covariance_union(other, one), atol=rounding)


@given(ANY, st.integers(0, 1000))
def test_the_fit_is_the_least_of_squares(T_a_b: FloatArray, seed: int) -> None:
    b = places(5, seed)
    a = se2.apply(T_a_b, b) + np.random.default_rng(seed).standard_normal(b.shape)
    best = fit_transform(a, b)

    def cost(T: FloatArray) -> float:
        return float(((se2.apply(T, b) - a) ** 2).sum())

    for step in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
        assert cost(se2.compose(best, se2.exp(step))) > cost(best)
