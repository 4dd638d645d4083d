"""Sigmas grow where drives contradict the model, until they cover by how much; those of gentle drives stay."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.merging import merge
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.joint_solve import component_of, solve_global_map
from groundsbot.offline.global_map.overdispersion import _solve_alone, misfit_of, noise_degrees_of_freedom
from groundsbot.offline.global_map.pass_scatter import scatter_of_passes, scatter_warnings
from groundsbot.offline.global_map.scale_checks import compare_wheels_and_tags
from groundsbot.offline.global_map.solve_component import SolvedComponent
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.mapping.findings import Findings
from groundsbot.offline.maps.result import Component
from groundsbot.offline.maps.shape import shape_of
from groundsbot.offline.maps.widening import inflate_covariances
from groundsbot.offline.measurements.passes import passes_of
from groundsbot.offline.measurements.segment import Segment
from groundsbot.offline.measurements.tape import TapeOptions, parse_measurements
from groundsbot.offline.noise.reweighing import fit_noise_of
from groundsbot.offline.outliers.tracks import instances, tracks_of, with_instances
from groundsbot.offline.sam.bias import covariance_with_bias
from groundsbot.offline.sam.graph import Graph, build_graph
from groundsbot.offline.sam.solver import Solution, solve
from tests.support.data.moved_tags import CLEAN, MOVED, make_scene

SEED = 41
MOVED_M = 0.5
Solved = tuple[list[LocalMap], Graph, Solution]


def with_errors_of_passes(segment: Segment, sigmas: float) -> Segment:
    """Each pass of a tag errs by so many sigmas that all of its observations share."""
    observations, of_pass = segment.observations, passes_of(segment)
    drawn = np.random.default_rng(SEED).standard_normal((int(of_pass.max()) + 1, 2))[of_pass]
    own = np.sqrt(np.diagonal(observations.covariance, axis1=1, axis2=2))
    return replace(segment, observations=replace(observations, value=observations.value + sigmas * own * drawn))


@cache
def solve_drives(kind: str, n_tags: int = 0, sigmas: float = 0.0) -> Solved:
    """Two drives as one map, moved tags taken for one."""
    drives = make_scene(SEED, kind, n_tags, MOVED_M).drives[1:3]
    segments = [drives[0].segment, with_errors_of_passes(drives[1].segment, sigmas)]
    maps = [solve_local_map(segment) for segment in segments]
    fitted = fit_noise_of(maps, NoiseParameters())
    maps = [fitted.solve(each) for each in maps]
    (group,) = merge(maps).groups
    return maps, *solve_global_map(maps, group, Stages())


def squared_sigmas(component: Component) -> float:
    """Mean square of the tags' errors about the first drive's start, in sigmas: 1 where covariances are right."""
    scene = make_scene(SEED)
    places = se2.apply(se2.inverse(scene.drives[1].T_town_start), scene.first_m)
    error = np.concatenate([tag.position_m - places[tag.tag_id] for tag in component.tags])
    return float(error @ np.linalg.solve(component.tag_covariance, error)) / len(error)


def test_gentle_drives_keep_their_sigmas() -> None:
    maps, graph, solution = solve_drives(CLEAN)
    assert misfit_of(maps, graph, solution) is None
    scatter = scatter_of_passes(graph, solution, 1.0, noise_degrees_of_freedom(maps))
    assert (scatter.factors == 1.0).all()
    assert scatter_warnings(graph, scatter) == []
    component = component_of(graph, solution)
    assert inflate_covariances(component, None, scatter) is component


@pytest.mark.parametrize(
    ("kind", "n_tags", "sigmas", "what"),
    [(CLEAN, 0, 3.0, "joins"), (CLEAN, 0, 1.5, "joins"), (MOVED, 4, 0.0, "joins")],
)
def test_sigmas_cover_by_how_much_drives_disagree(kind: str, n_tags: int, sigmas: float, what: str) -> None:
    """Passes of one drive err by what their observations share, or tags were moved in between and taken for one."""
    maps, graph, solution = solve_drives(kind, n_tags, sigmas)
    misfit = misfit_of(maps, graph, solution)
    assert misfit is not None
    assert misfit.kind == what
    if sigmas:
        assert misfit.run == graph.segments[1].name
    before = component_of(graph, solution)
    after = inflate_covariances(
        deepcopy(before),
        misfit,
        scatter_of_passes(graph, solution, misfit.variance_factor, noise_degrees_of_freedom(maps)),
    )
    assert after.sigma_factor == misfit.variance_factor**0.5
    assert squared_sigmas(before) > 1.05
    assert 0.5 < squared_sigmas(after) < 1.5


def test_a_tag_whose_passes_contradict_each_other_gets_the_sigma_of_their_scatter() -> None:
    maps, graph, solution = solve_drives(MOVED, 1)
    scatter = scatter_of_passes(graph, solution, 1.0, noise_degrees_of_freedom(maps))
    (moved,) = make_scene(SEED, MOVED, 1, MOVED_M).ids
    (which,) = np.flatnonzero(scatter.factors > 1.0)
    assert graph.tags[which].tag_id == moved
    (said,) = scatter_warnings(graph, scatter)
    assert f"passes of tags {moved} (" in said
    before = component_of(graph, solution)
    after = inflate_covariances(deepcopy(before), None, scatter)
    grown = after.joint_covariance - before.joint_covariance
    rows = slice(6 + 2 * which, 8 + 2 * which)
    sigmas_m = np.sqrt(np.linalg.eigvalsh(grown[rows, rows]))
    # Two places half a metre apart: their mean is known to a quarter, less what the poses gave in.
    assert 0.05 < sigmas_m[1] < 0.3
    np.testing.assert_allclose(after.tags[which].covariance, after.joint_covariance[rows, rows])
    grown[rows, rows] = 0.0
    assert not grown.any()
    assert (after.sigma_factor, after.misfit) == (1.0, None)
    # Where everything grows anyway, a tag needs less of its own.
    less = scatter_of_passes(graph, solution, 100.0, noise_degrees_of_freedom(maps))
    assert not less.added_m2.any()


def test_tags_split_since_are_compared_with_a_drive_of_as_many() -> None:
    """A drive's own solve has one place for a tag to which the joint solve gives two: it is solved again with both."""
    maps, graph, solution = solve_drives(CLEAN, 0, 3.0)
    tracks = tracks_of([maps[1].segment])
    apart = with_instances([maps[1].segment], tracks, instances(tracks, np.arange(len(tracks)), "second "))[0]
    again = build_graph([graph.segments[0], apart])
    start = again.start(solution.state.poses, {}, graph.calibration_of(solution.state))
    split = solve(again.problem, start)
    alone = _solve_alone(maps[1], again, split, 1)
    assert alone.problem.n_residuals == maps[1].solution.problem.n_residuals
    assert len(alone.state.tags) == len(tracks)
    assert alone.cost < maps[1].solution.cost
    assert _solve_alone(maps[0], again, split, 0) is maps[0].solution


def test_what_is_found_of_a_component_has_the_factor_everywhere() -> None:
    maps, graph, solution = solve_drives(MOVED, 4)
    (group,) = merge(maps).groups
    found, misfit = Findings(), misfit_of(maps, graph, solution)
    assert misfit is not None
    nothing = parse_measurements(TapeOptions(), [segment.name for segment in graph.segments], list(graph.tags))
    corrected = found.add(maps, SolvedComponent(group, graph, solution, []), nothing, Stages()).solution
    (component,) = found.components
    factor = misfit.variance_factor**0.5
    assert (component.misfit, component.sigma_factor) == (misfit, factor)
    columns = corrected.problem.columns.calibration
    calibration_sigmas = np.sqrt(np.diag(covariance_with_bias(corrected, columns[columns >= 0])))
    check_sigmas = [each.sigma for each in compare_wheels_and_tags(graph, corrected, 0)]
    for own, computed in ((found.calibration, calibration_sigmas), (found.checks, check_sigmas)):
        assert len(own) > 0
        np.testing.assert_allclose([each.sigma for each in own], factor * np.asarray(computed))
    shape = shape_of(component)
    assert shape is not None
    assert found.advice[0].sigma_m == pytest.approx(
        shape.tag_sigmas_m.max(), rel=1e-3
    )  # at places before the correction
