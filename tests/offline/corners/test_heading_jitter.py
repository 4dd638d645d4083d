"""Headings that a gyro does not resolve are noise of the corners seen from there."""

from dataclasses import replace

import numpy as np

from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.corners.factors import columns_of
from groundsbot.offline.corners.graph import corner_graph
from groundsbot.offline.corners.heading_jitter import with_heading_jitter
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.measurements.segment import segments_of
from tests.offline.corners.made_problems import N_LOOKS, N_POSES, N_TAGS, SIGMAS, make_factors, make_state
from tests.support.data.gyros import SimulatedGyro, gyro_runs


def test_corners_are_whitened_by_the_jitter_of_the_heading() -> None:
    rng = np.random.default_rng(3)
    factors, state = make_factors(rng), make_state(rng)
    columns = columns_of(N_POSES, np.ones(N_TAGS, dtype=np.bool_), SIGMAS)
    sigma_rad = np.where(np.arange(N_LOOKS) % 3 == 0, 0.0, 3e-3)
    plain, plain_by_attitude = factors.linearise(state, columns)
    found, by_attitude = with_heading_jitter(factors, state, columns, sigma_rad).linearise(state, columns)
    (_, J), (_, whitened) = plain.blocks[0], found.blocks[0]
    for m in range(N_LOOKS):
        u = sigma_rad[m] * J[m, :, 2]
        information = np.linalg.inv(np.eye(8) + np.outer(u, u))
        np.testing.assert_allclose(
            found.residual[m] @ found.residual[m], plain.residual[m] @ information @ plain.residual[m]
        )
        for own, before in ((whitened[m], J[m]), (by_attitude[m], plain_by_attitude[m])):
            expected = before.T @ information @ before
            np.testing.assert_allclose(own.T @ own, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_a_map_with_a_gyro_has_the_jitter_and_one_without_has_none() -> None:
    run = gyro_runs("room", 1, SimulatedGyro())[0][0]
    for each in (run, replace(run, gyro=None)):
        (segment,) = segments_of(each, NoiseParameters())
        local_map = solve_local_map(segment)
        corners, start = corner_graph(local_map.graph, local_map.solution.state)
        factors, sigma_rad = corners.problem.corners, segment.observations.heading_jitter_rad
        jitter = factors.observations.jitter
        plain = replace(factors, observations=factors.observations._replace(jitter=np.zeros_like(jitter)))
        by_heading = plain.linearise(start, corners.problem.columns)[0].blocks[0][1][..., 2]
        expected = 1.0 / (1.0 + sigma_rad**2 * (by_heading**2).sum(axis=1))
        np.testing.assert_allclose((1.0 - (jitter**2).sum(axis=1)) ** 2, expected, rtol=1e-9)
        assert sigma_rad.any() == jitter.any() == (each.gyro is not None)
