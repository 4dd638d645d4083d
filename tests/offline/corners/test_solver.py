"""The solve on tag corners: where whole steps overshoot, and where they are too short."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.corners.graph import corner_graph
from groundsbot.offline.corners.solver import solve_corners
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.measurements.run import load_run
from tests.support.data.drives import HALL, make_drive, make_robot, picture_stamps, write_drive
from tests.support.data.simulated_runs import simulated_runs


def test_a_step_that_swings_the_far_end_by_a_metre_is_taken_in_part() -> None:
    """Drives whose far end the first step would move by 1.1 m, to where the cost is higher.

    With damping instead, this took more than 40 steps and the map stayed on the floor.
    """
    workings = Diagnostics(keeps_corners=True)
    build_map(simulated_runs("nsh_flat", 2)[0], workings=workings)
    (solved,) = workings.components
    corners, start = corner_graph(solved.graph, solved.solution.state)
    found = solve_corners(corners.problem, start)
    assert found.converged, found.reason
    assert len(found.costs) < 10
    assert all(later < before for before, later in zip(found.costs, found.costs[1:], strict=False))


@pytest.mark.parametrize(("numbers", "seed"), [((4, 15, 22, 27), 19), ((3, 4, 13, 28), 57)])
def test_four_pictures_with_noisy_corners_and_a_pitched_camera_converge(
    numbers: tuple[int, ...], seed: int, tmp_path: Path
) -> None:
    """Most detections are outliers: Gauss-Newton takes steps of half the length, or crawls past a saddle point."""
    robot, drive = make_robot("a"), make_drive([1.0, 1.5, 0.3], [(0.4, 0.4, 2.0), (0.5, 0.3, 2.0), (-0.3, 0.3, 5.0)])
    pictures_ns = picture_stamps(drive, 4.0)[list(numbers)]
    tags = [replace(tag, roll_rad=0.0) for tag in HALL]
    run = load_run(write_drive(tmp_path, drive, tags, robot, pictures_ns=pictures_ns, corner_sigma_px=1.0, seed=seed))
    wrong = robot.mount.model_copy(update={"pitch_rad": robot.mount.pitch_rad + np.radians(5.0)})
    workings = Diagnostics(keeps_corners=True)
    build_map(
        [replace(run, robot=run.robot.model_copy(update={"mount": wrong}))], noise=NoiseParameters(), workings=workings
    )
    (solved,) = workings.components
    corners, start = corner_graph(solved.graph, solved.solution.state)
    found = solve_corners(corners.problem, start)
    assert found.converged, found.reason
    assert len(found.costs) < 30  # more than 40 otherwise
