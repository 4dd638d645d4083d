"""Small joint problems with every kind of factor, far from their minimum, and what plain algebra makes of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS, EDGE_SHIFT, RANGE_OFFSET, TIME_OFFSET
from groundsbot.offline.estimate import problem as problem_file
from groundsbot.offline.estimate.drive import Drive
from groundsbot.offline.estimate.estimate import noises_before
from groundsbot.offline.estimate.kernels import Variables, errors_of_motions, errors_of_readings
from groundsbot.offline.estimate.parameters import DEPTH, CalibrationModel, Owned, Prior, calibration_of
from groundsbot.offline.estimate.problem import NO_TAPE, JointProblem, Noise, PlaceScales, Tape
from groundsbot.offline.sam.multifrontal.kernels import FrontalSystem
from tests.offline.estimate.made_drives import Truth, imported_robot, make_drive

DELAYS_S: Final = {"a": 0.11, "b": 0.06}
TRUTH: Final = Truth(mount=(0.1, -0.05, 0.2))
STEP: Final = 3e-5  # of differences, in m, rad, and units of a parameter
PRIORS: Final = 4  # among the kinds of residuals
OPEN: Final = [CAMERA_PARAMETERS.index(name) for name in ("mount_roll_rad", "mount_pitch_rad", EDGE_SHIFT)]


def make_problem(
    late_s: float = 0.0, seconds: float = 10.0, *, with_tape: bool = False, without: Sequence[str] = ()
) -> tuple[JointProblem, Variables]:
    """Two drives of robot a, which gives ranges, and one of b, which gives x and y, with values at random.

    Args:
        late_s: by which the delays of the values are above those that the motions are composed for.
        seconds: of each drive.
        with_tape: with three measured distances.
        without: parameters that are known, to be zero.
    """
    rng = np.random.default_rng(7)
    measured = imported_robot("b").model_copy(update={"time_offset_s_sigma": 0.01})
    measured = measured.model_copy(update={"wheels": measured.wheels.model_copy(update={"track_m_sigma": 0.005})})
    made = [
        make_drive("a", 1, seconds, TRUTH),
        make_drive("b", 1, seconds, TRUTH, xy=True, robot=measured),
        make_drive("a", 2, seconds, TRUTH),
    ]
    drives = []
    for each in made:
        segment = each.segment
        by_camera = segment.observations.by_camera.copy()
        by_camera[:, :, OPEN] = 0.3 * rng.standard_normal((len(by_camera), 2, len(OPEN)))
        segment = replace(segment, observations=replace(segment.observations, by_camera=by_camera))
        delay_s = 0.0 if TIME_OFFSET in without else DELAYS_S[segment.run.robot_id]
        drives.append(Drive.of(segment).with_delay(delay_s))
    calibration = calibration_of(drives)
    for name in [*(CAMERA_PARAMETERS[k] for k in OPEN), DEPTH]:
        calibration.add(Owned("b", name), 0.5)
    terms = ((Owned("b", DEPTH), 0.4), (Owned("a", DEPTH), -1.3), (Owned("b", RANGE_OFFSET), 2.0))
    calibration.priors.append(Prior(terms, 0.1, 0.05))
    calibration = CalibrationModel(
        [each for each in calibration.names if each.name not in without],
        [each for each in calibration.priors if each.terms[0][0].name not in without],
    )
    n_a, n_b, _ = (len(drive.segment.tags) for drive in drives)
    start_of_b = drives[0].n_poses
    pose, point = np.array([[start_of_b, -1], [-1, -1], [0, -1]]), np.array([[-1, n_a + n_b], [1, n_a + 1], [-1, 0]])
    tape = Tape(pose, point, np.array([2.0, 3.0, 1.0]), np.array([0.1, 0.4, 0.2])) if with_tape else NO_TAPE
    noises = [_noise(drive) for drive in drives]
    problem = JointProblem(drives, calibration, noises, PlaceScales(0.2, 0.3), by_pass=True, tape=tape)
    n = len(calibration.names)
    c = np.append(0.0, 0.1 * rng.standard_normal(n - 1))
    for robot, delay_s in DELAYS_S.items():
        if index := calibration.index(Owned(robot, TIME_OFFSET)):
            c[index] = delay_s + late_s
    poses = np.concatenate([each.at(drive.stamps_ns) for each, drive in zip(made, drives, strict=True)])
    poses += 0.1 * rng.standard_normal(poses.shape)
    layout = problem.layout
    tags = [own.tag for own in layout.own] + layout.joint
    at = np.array([made[0].places[tag.tag_id] for tag in tags])
    points = np.concatenate([at, at[layout.of_pass]])
    points += 0.2 * rng.standard_normal(points.shape)
    values = problem.centre(Variables(poses, points, c))
    problem.hold_priors(values)
    return problem, values


def _noise(drive: Drive) -> Noise:
    default, _ = noises_before(drive, NoiseParameters())
    return Noise(3.0 * default.motion, {name: 2.0 * value for name, value in default.reading.items()})


def derivatives(of: Callable[[FloatArray], FloatArray], n: int) -> FloatArray:
    """(..., n) derivatives at zero by differences of fourth order."""
    found = []
    for along in STEP * np.eye(n):
        near, far = of(along) - of(-along), of(2.0 * along) - of(-2.0 * along)
        found.append((8.0 * near - far) / (12.0 * STEP))
    return np.stack(found, axis=-1)


def dense(system: FrontalSystem) -> FloatArray:
    """(n, n) matrix of a system whose fronts are not eliminated yet."""
    nodes, n = system.nodes, len(system.gradient)
    found = np.zeros((n, n))
    for i in range(len(nodes.parent)):
        columns = nodes.columns[nodes.start[i] : nodes.start[i + 1]]
        front = system.entries[nodes.offset[i] : nodes.offset[i + 1]].reshape(len(columns), len(columns))
        found[np.ix_(columns, columns)] += np.triu(front)
        found[np.ix_(columns, columns)] += np.triu(front, 1).T
    return found


def spread_information(problem: JointProblem, values: Variables) -> tuple[IntArray, float]:
    """Columns of the places whose spread has a prior, and its information about each."""
    total = spread(problem, values)
    return problem.columns[1][problem.in_map].reshape(-1), 2.0 * power_of_spread(problem, values) / total


def spread(problem: JointProblem, values: Variables) -> float:
    """Sum of the squares of the places about their mean."""
    places = values.points[problem.in_map]
    return float(((places - places.mean(axis=0)) ** 2).sum())


def power_of_spread(problem: JointProblem, values: Variables, by: float = 1.3) -> float:
    """The power of the spread that is the density of the places: of a cost that no residual has, as places part."""
    there = values._replace(points=by * values.points)
    costs = [problem.system(each, is_whole=False)[1] - cost_of_residuals(problem, each) for each in (values, there)]
    return float((costs[1] - costs[0]) / np.log(spread(problem, there) / spread(problem, values)))


def cost_of_residuals(problem: JointProblem, values: Variables) -> float:
    """Of all but priors on the calibration."""
    parts = [each for k, each in enumerate(residuals(problem, values)) if k != PRIORS]
    return float(sum(0.5 * (nu + e.shape[1]) * np.log1p((e**2).sum(axis=1) / nu).sum() for nu, e in parts))


def residuals(problem: JointProblem, values: Variables) -> list[tuple[float, FloatArray]]:
    """Degrees of freedom and whitened residuals (M, d) of each kind of factor, d of which have one tail."""
    motions, _ = errors_of_motions(problem.motions, values, 4.0)
    readings, _ = errors_of_readings(problem.readings, values, 4.0)
    c, points = values.calibration, values.points
    first, layout = problem.layout.first_pose, problem.layout
    own, joint = layout.tie.T
    unit = np.exp(-c[problem.map_scale])  # metres of the first robot's wheels
    of_drive = unit * (points[own] - points[joint]) / problem.places.of_drive_m
    at = np.arange(layout.n_places, layout.n_points)
    units = np.exp(-c[problem.distance_of_points[at]])
    of_pass = units[:, None] * (points[at] - points[layout.of_pass]) / problem.places.of_pass_m
    calibration = problem.calibration
    priors = [
        (sum(k * c[calibration.index(name)] for name, k in each.terms) - each.mean) / each.sigma
        for each in calibration.priors
    ]
    taped = []
    for pose, point, distance_m, sigma_m in zip(*problem.tape, strict=True):
        a, b = (values.poses[i, :2] if i >= 0 else points[j] for i, j in zip(pose, point, strict=True))
        taped.append((np.hypot(*(b - a)) - distance_m) / sigma_m)
    assert first[0] == 0
    nu, of_places = problem_file.NU, problem_file.NU_PLACES
    return [
        (nu, motions.reshape(-1, 1)),
        (nu, readings),
        (of_places, of_drive),
        (nu, of_pass),
        (nu, np.array(priors).reshape(-1, 1)),
        (nu, np.array(taped).reshape(-1, 1)),
    ]


def information(problem: JointProblem, values: Variables) -> FloatArray:
    """(n, n) J^T W J of all residuals, and of the prior on the places' spread, by differences."""
    n = problem.columns[3]
    found = np.zeros((n, n))
    here = residuals(problem, values)
    for k, (nu, e) in enumerate(here):
        J = derivatives(lambda step, k=k: residuals(problem, problem.move(values, step))[k][1], n)  # type: ignore[misc]
        w = (nu + e.shape[1]) / (nu + (e**2).sum(axis=1))
        found += np.einsum("m,mda,mdb->ab", w, J, J, optimize=True)
    columns, of_spread = spread_information(problem, values)
    found[columns, columns] += of_spread
    return found
