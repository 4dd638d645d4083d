"""Whether runs fit together is tested on existing solves, and agrees with fitting the windows of all of them."""

from dataclasses import replace
from functools import cache

import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.merging import merge
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.goodness_of_fit import joint_goodness_of_fit
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map.goodness_of_fit import GoodnessOfFit, fit_windows
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.noise.reweighing import fit_noise_of
from groundsbot.offline.sam.solver import Solution
from tests.support.data.moved_tags import CLEAN, MOVED, make_scene


@cache
def map_runs(kind: str, n_tags: int) -> tuple[list[LocalMap], Solution]:
    """Two runs under fitted noise, joined; tags are moved between them and taken for one all the same."""
    drives = make_scene(41, kind, n_tags, 0.5).drives[1:3]
    maps = [solve_local_map(drive.segment) for drive in drives]
    fitted = fit_noise_of(maps, NoiseParameters())
    maps = [fitted.solve(each) for each in maps]
    (group,) = merge(maps).groups
    _, solution = solve_global_map(maps, group, Stages())
    return maps, solution


def by_windows(solution: Solution, least_factor: float = 0.0) -> GoodnessOfFit:
    return fit_windows(solution.problem, least_factor=least_factor).goodness_of_fit(solution.state)


@pytest.mark.parametrize(("kind", "n_tags", "fits"), [(CLEAN, 0, True), (MOVED, 4, False)])
def test_it_says_what_the_windows_of_all_runs_say(kind: str, n_tags: int, *, fits: bool) -> None:
    maps, solution = map_runs(kind, n_tags)
    assert all(each.goodness.fits for each in maps)
    # Fitted noise counts what observations share, of which windows show less.
    found, all_windows = joint_goodness_of_fit(maps, solution), by_windows(solution, least_factor=1.0)
    assert found.fits == all_windows.fits == fits
    assert found.expected == all_windows.expected
    assert found.chi_square == pytest.approx(all_windows.chi_square, rel=0.2)
    assert found.bound == pytest.approx(all_windows.bound, rel=0.2)


def test_given_sigmas_are_tested_against_residuals() -> None:
    """Windows then show how far off they are, and nothing is added up."""
    maps, solution = map_runs(CLEAN, 0)
    told = [replace(each, goodness=replace(each.goodness, observation_factor=1.5)) for each in maps]
    assert joint_goodness_of_fit(told, solution) == by_windows(solution)
    assert joint_goodness_of_fit(maps, solution) != by_windows(solution)
