"""Condensed maps held together by their tags: the joint solve's cost without the joint solve, bends included."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.condensed_map import condense
from groundsbot.offline.alignment.joint_fit import JointFit, fit_members
from groundsbot.offline.alignment.merging import Group
from groundsbot.offline.alignment.pairwise import align
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.sam.bias import covariance_with_bias
from tests.support.data.long_drives import NOISE, make_long_drive, make_town


@cache
def solve_town(seed: int, noise: NoiseParameters = NOISE) -> LocalMap:
    """Through one town; by default with a heading that wanders by 2 degrees a metre's root."""
    drive = make_long_drive(seed, 300.0, town=make_town(7, (2.0, 8.0)), noise=noise, noise_factors=(1.0, 1.0))
    return solve_local_map(drive.segment)


def fit_of(a: LocalMap, b: LocalMap, unmodelled_sigma_m: float = 0.0) -> JointFit:
    shared = sorted(set(a.graph.tags) & set(b.graph.tags))
    tree_a, tree_b = (condense(each, each.graph.tags).tree(shared) for each in (a, b))
    return JointFit(tree_a, tree_b, unmodelled_sigma_m)


@pytest.mark.parametrize(("a", "b"), [(1, 2), (4, 5)])
def test_the_rise_is_that_of_the_joint_solve_though_the_maps_are_bent(a: int, b: int) -> None:
    maps = [solve_town(a), solve_town(b)]
    fit = fit_of(maps[0], maps[1])
    sure = align(condense(maps[0], maps[0].graph.tags), condense(maps[1], maps[1].graph.tags))
    assert sure is not None
    everything = np.ones(fit.n, dtype=np.bool_)
    linear, held = fit.solve(fit.point_without_errors(sure.T_a_b), everything)
    _, together = solve_global_map(maps, Group((0, 1), np.array([np.zeros(3), linear.at.T_a_b])), Stages())
    rise = 2.0 * (together.cost - sum(each.solution.cost for each in maps))
    assert held.cost_increase == pytest.approx(rise, rel=0.05, abs=1.0)
    assert held.cost_increase < chi2.isf(1e-4, 2 * fit.n - 3)
    # In map axes, as if a bend were none, the same maps seem to contradict each other.
    assert abs(
        fit_members(fit.linearise(fit.point_without_errors(linear.at.T_a_b)), everything).cost_increase - rise
    ) > 3.0 * abs(held.cost_increase - rise)


def test_a_condensed_map_has_the_places_and_the_covariance_of_the_solve() -> None:
    local_map = solve_town(1)
    tags = local_map.graph.tags
    condensed = condense(local_map, tags, variance_factor=4.0)
    np.testing.assert_allclose(condensed.tags_m, local_map.solution.state.tags, atol=1e-12)
    tree = condensed.tree(tags)
    places, jacobian = tree.jacobian(np.zeros(5 * len(tags)))
    np.testing.assert_allclose(places, condensed.tags_m, atol=1e-9)
    # The tree leaves its root where it is: distances between tags know nothing of that.
    columns = local_map.graph.problem.columns.tags
    full = 4.0 * covariance_with_bias(local_map.solution, columns.reshape(-1))
    own = jacobian @ tree.covariance @ jacobian.T
    for i, j in ((0, 1), (2, len(tags) - 1)):
        along = (places[j] - places[i]) / np.linalg.norm(places[j] - places[i])
        row = np.zeros(2 * len(tags))
        row[2 * i : 2 * i + 2], row[2 * j : 2 * j + 2] = -along, along
        assert row @ own @ row == pytest.approx(row @ full @ row, rel=1e-6)


def test_derivatives_of_the_tree_are_the_finite_differences_where_it_is_bent() -> None:
    local_map = solve_town(1)
    tree = condense(local_map, local_map.graph.tags).tree(local_map.graph.tags[:6])
    xi = 0.1 * np.random.default_rng(0).standard_normal(30)
    _, jacobian = tree.jacobian(xi)
    for column, step in enumerate(1e-6 * np.eye(30)):
        slope = (tree.places(xi + step)[0] - tree.places(xi - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, column].reshape(-1, 2), slope, atol=1e-6)


def test_a_tag_a_metre_off_is_noticed_where_its_own_sigma_is_larger() -> None:
    """What a tag's own covariance would let pass, its neighbours do not."""
    a, b = (condense(each, each.graph.tags) for each in (solve_town(4), solve_town(5)))
    clean = align(a, b)
    assert clean is not None
    assert len(clean.outliers) == 0
    columns = solve_town(5).graph.problem.columns.tags
    variance_m2 = {tag: np.trace(solve_town(5).solution.covariance(columns[i])) for i, tag in enumerate(b.tags)}
    wrong = max(clean.inliers, key=lambda tag: variance_m2[tag])
    assert variance_m2[wrong] > 1.0
    tag_m = b.tag_m.copy()
    tag_m[b.tags.index(wrong)] += [0.8, 0.6]
    found = align(a, replace(b, tag_m=tag_m))
    assert found is not None
    assert found.is_accepted
    assert found.outliers == (wrong,)
