"""The joint estimate of all drives: each alone, placed by shared tags, then all of a component together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import TIME_OFFSET, NoiseParameters
from groundsbot.offline.estimate.alignment import place
from groundsbot.offline.estimate.drive import Drive, reading_variances
from groundsbot.offline.estimate.kernels import Variables
from groundsbot.offline.estimate.likelihood import default_noise, update
from groundsbot.offline.estimate.parameters import DISTANCE, RANGE_SCALE, Owned, calibration_of
from groundsbot.offline.estimate.problem import JointProblem, Noise, PlaceScales, Tape, places_of
from groundsbot.offline.estimate.start import Alone, earlier, solve_alone
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.measurements import MeasuredDistance, Segment, TagKey
from groundsbot.offline.sam import FrontFactor

# Noise to grow a drive with: that of poor wheels and of a poor camera. Tails do the rest.
_WIDE_MOTION: Final = (0.06, 0.03, 0.08, 0.08)
_WIDE_READING: Final[Mapping[str, float]] = {
    "sigma_range_m": 0.05,
    "sigma_range_per_m": 0.03,
    "sigma_bearing_rad": 0.03,
    "sigma_stamp_s": 0.02,
    "sigma_corner_px": 0.5,
}
_MOST_ROUNDS: Final = 20
_LOOSE: Final = 1.0  # predicted decrease of the cost at which the first solve ends, under the noise of single drives
_FEW_STEPS: Final = 15
_TOLERANCE: Final = 0.03
_FINAL_TOLERANCE: Final = 0.01  # flat valleys are long
_MEMORY: Final = 6
_RELAXED: Final = 0.5  # share of the change of a tilt that is taken in a round
_MOST_STRETCH: Final = 0.2
_CLOSE: Final = 0.1  # in standard errors: how near to the marginal likelihood's maximum the noise is


@dataclass
class Joint:
    """A component of drives solved together.

    Attributes:
        members: drives by their index in the estimate.
        problem: their problem under the fitted noise.
        values: all variables, in the frame of the first member's start.
        factor: factor of the information there.
        converged: whether the last solve converged.
        change: the last step of the noise in standard errors.
        n_linearisations: of all keyframes together.
        counts: number of residuals behind each scale of the noise of each drive.
    """

    members: list[int]
    problem: JointProblem
    values: Variables
    factor: FrontFactor
    converged: bool
    change: float
    n_linearisations: int
    counts: list[dict[str, float]]

    @cached_property
    def tags(self) -> list[TagKey]:
        """Tags of the map, in the order of `points`."""
        layout = self.problem.layout
        names = [own.tag for own in layout.own] + layout.joint
        return [names[i] for i in self.problem.in_map]

    @cached_property
    def seen(self) -> FloatArray:
        """(M, 2) where each reading puts its tag in map."""
        return places_of(self.problem.readings, self.values)

    @property
    def tags_m(self) -> FloatArray:
        """(T, 2) places of the tags in map."""
        return self.values.points[self.problem.in_map]

    def covariance(self, poses: IntArray, points: IntArray, parameters: IntArray) -> FloatArray:
        """Return the joint covariance of some poses (x, y, theta), points (x, y) and parameters, in the held frame.

        A point's own uncertainty is that of its place in map, and by how much a drive's view of a place is off.
        """
        problem = self.problem
        of_poses, of_points, of_calibration, _ = problem.columns
        distance = np.concatenate(
            [np.repeat(problem.distance_of_poses[poses], 3), np.repeat(problem.distance_of_points[points], 2)]
        )
        stretches = problem.scale_columns(distance)
        scales = np.unique(np.concatenate(stretches))
        scales = scales[scales >= 0]
        own = np.concatenate([of_poses[poses].reshape(-1), of_points[points].reshape(-1), of_calibration[parameters]])
        n, k = len(own), len(distance)
        found = self.factor.covariance(np.concatenate([own, scales]).astype(np.int64))
        places = self.values.poses[poses] * [1.0, 1.0, 0.0]
        place = np.concatenate([places.reshape(-1), self.values.points[points].reshape(-1)])
        J = np.eye(n, n + len(scales))
        for i, column in enumerate(scales.tolist()):
            for stretch in stretches:
                J[:k, n + i] += np.where(stretch == column, place, 0.0)
            if column == of_calibration[problem.map_scale]:  # a change of the stretch adds to the others' ln distances
                J[k:, n + i] = np.isin(parameters, problem.calibration.scaled_with_map)
        found = J @ found @ J.T
        at = slice(3 * len(poses), k)
        found[at, at] += self.problem.places.of_drive_m**2 * np.eye(2 * len(points))
        return found

    @property
    def tag_covariance(self) -> FloatArray:
        """(2 T, 2 T) of the tags' places in map, in m^2."""
        none = np.zeros(0, dtype=np.int64)
        return self.covariance(none, self.problem.in_map, none)


def _solve_alone(item: tuple[Segment, NoiseParameters], _stages: Stages) -> Alone:
    segment, prior = item
    drive = Drive.of(segment)
    default, wide = noises_before(drive, prior)
    return solve_alone(drive, wide, default)


def noises_before(drive: Drive, prior: NoiseParameters) -> tuple[Noise, Noise]:
    """Return a drive's default noise, and the wide one that it grows with."""
    names, _ = reading_variances(drive)
    default = default_noise(names, prior)
    return default, Noise(np.array(_WIDE_MOTION), {name: _WIDE_READING.get(name, 3.0) for name in names})


def solve_joint(
    members: Sequence[int],
    alone: Sequence[Alone],
    T_map_start: Mapping[int, FloatArray],
    prior: NoiseParameters,
    distances: Sequence[MeasuredDistance] = (),
) -> Joint:
    """Solve drives together, from their own solutions, placed in map.

    Args:
        members: drives by their index.
        alone: all drives.
        T_map_start: pose (3,) of the frame of each member in map.
        prior: noise before the drives were seen.
        distances: by a person; those are used whose ends the members have.
    """
    problem, values = _problem_of(members, alone, T_map_start, distances)
    defaults, noises = [noises_before(drive, prior)[0] for drive in problem.drives], problem.noises
    tilt, n = problem.measure, 0
    tried: list[tuple[FloatArray, FloatArray]] = []
    for number in range(_MOST_ROUNDS):
        problem, values = _at_delays(problem, values, noises)
        values = problem.centre(values)
        if number == 0:
            found = problem.minimise(values, None, _LOOSE, _FEW_STEPS)
            problem.hold_priors(found.values)  # at the mode: held where the tilt leads, they would let go ever more
        else:
            found = problem.minimise(values, tilt, _TOLERANCE)
        values, n = found.values, n + found.n_linearisations
        factor = found.factor if found.converged and found.factor else problem.factor_at(values)
        new = update(problem, values, factor, defaults)
        columns = problem.free_parameters
        covariance, off = factor.covariance(columns), (new.tilt - tilt)[columns]
        tried.append((tilt[columns], off))
        change = max(new.change, float(np.sqrt(off @ covariance @ off / max(len(columns), 1))))
        new = new._replace(change=change)
        tilt_of_values, tilt = tilt, new.tilt.copy()
        tilt[columns] = _mix(tried[-_MEMORY:], covariance)
        if len(problem.in_map) < 2:  # nothing tells the scale, and nothing is to be corrected
            tilt = problem.measure
        if new.change < _CLOSE or number == _MOST_ROUNDS - 1:
            last = problem.minimise(values, tilt_of_values, _FINAL_TOLERANCE, _FEW_STEPS)
            factor = problem.factor_at(last.values, is_information=True)
            n += last.n_linearisations
            return Joint(list(members), problem, last.values, factor, found.converged, new.change, n, new.counts)
        noises = new.noises
        problem.set_noise(noises, new.places)
    raise AssertionError("unreachable")


def _problem_of(
    members: Sequence[int],
    alone: Sequence[Alone],
    T_map_start: Mapping[int, FloatArray],
    distances: Sequence[MeasuredDistance],
) -> tuple[JointProblem, Variables]:
    """Return the problem of some drives under the noise of each alone, and its start values; see `solve_joint`."""
    drives = [alone[m].drive for m in members]
    calibration = calibration_of(drives)
    c = calibration.values
    for m in members:
        own = alone[m].problem.calibration
        for owned, value in zip(own.names[1:], alone[m].values.calibration[1:].tolist(), strict=True):
            c[calibration.index(owned)] = value
    tape = _tape(drives, distances)
    problem = JointProblem(
        drives, calibration, [alone[m].noise for m in members], PlaceScales(), by_pass=True, tape=tape
    )
    stretches = _log_scales([alone[m].places for m in members])
    poses, places = [], dict[tuple[int, TagKey], FloatArray]()
    for k, m in enumerate(members):
        T, own_poses, by = T_map_start[m], alone[m].values.poses, np.exp(stretches[k])
        T = np.append(_middle(alone[m].places, T) - by * se2.apply([0.0, 0.0, T[2]], _middle(alone[m].places)), T[2])
        poses.append(np.column_stack([se2.apply(T, by * own_poses[:, :2]), own_poses[:, 2] + T[2]]))
        places |= {(k, tag): se2.apply(T, by * at) for tag, at in alone[m].places.items()}
        robot_id = drives[k].segment.run.robot_id
        for name, sign in ((DISTANCE, 1.0), (RANGE_SCALE, -1.0)):
            if index := calibration.index(Owned(robot_id, name)):
                c[index] += sign * stretches[k]
    layout = problem.layout
    own_m = np.array([places[each.drive, each.tag] for each in layout.own]).reshape(-1, 2)
    tags = [each.tag for each in layout.own]
    medians = [np.median(own_m[[each == tag for each in tags]], axis=0) for tag in layout.joint]
    points = np.concatenate([own_m, np.array(medians).reshape(-1, 2), np.zeros((len(layout.of_pass), 2))])
    values = Variables(np.concatenate(poses), points, c)
    seen, point = places_of(problem.readings, values), problem.readings.point
    for k in range(layout.n_places, layout.n_points):
        points[k] = np.median(seen[point == k], axis=0)
    return problem, values


def _mix(tried: Sequence[tuple[FloatArray, FloatArray]], covariance: FloatArray) -> FloatArray:
    """Return the next tilt from those tried and how far they were from what they led to (Anderson 1965).

    Where noise is large, a tilt depends much on where it is evaluated, and taking each as it comes goes to and fro.
    """
    x, off = (np.array(each) for each in zip(*tried, strict=True))
    variances, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(variances, 0.0))
    weights = np.zeros(len(x))
    weights[-1] = 1.0
    if len(x) > 1:
        apart = np.diff(off, axis=0) @ root
        gamma = np.linalg.lstsq(apart.T, off[-1] @ root, rcond=1e-3)[0]
        weights[1:] -= gamma
        weights[:-1] += gamma
    return np.asarray(weights @ x + _RELAXED * (weights @ off))


def _log_scales(places: Sequence[Mapping[TagKey, FloatArray]]) -> FloatArray:
    """Return the logarithm by which each drive's map is to be stretched to be as large as the others are on average.

    A drive alone hardly knows its scale, and ranges and wheels can be stretched together.
    """
    ratios = np.zeros((len(places), len(places)))
    for i, one in enumerate(places):
        for j, other in enumerate(places[:i]):
            shared = sorted(set(one) & set(other))
            if len(shared) < 2:
                continue
            spans = [np.linalg.norm(np.std([each[tag] for tag in shared], axis=0)) for each in (one, other)]
            ratios[i, j] = np.log(max(float(spans[1]), 1e-3) / max(float(spans[0]), 1e-3))
            ratios[j, i] = -ratios[i, j]
    return np.asarray(np.clip(ratios.mean(axis=1), -_MOST_STRETCH, _MOST_STRETCH))


def _middle(places: Mapping[TagKey, FloatArray], T: FloatArray | None = None) -> FloatArray:
    """Return the mean of places (2,), moved by T if given."""
    middle = np.mean([*places.values()], axis=0) if places else np.zeros(2)
    return middle if T is None else np.asarray(se2.apply(T, middle))


def _tape(drives: Sequence[Drive], distances: Sequence[MeasuredDistance]) -> Tape:
    """Return the distances between starts and tags of the drives."""
    lengths = np.cumsum([0, *(each.n_poses for each in drives)]).tolist()
    starts: dict[str | TagKey, int] = {each.segment.name: first for each, first in zip(drives, lengths, strict=False)}
    names = [(d, tag) for d, drive in enumerate(drives) for tag in drive.segment.tags]
    seen = [tag for _, tag in names]
    joint = sorted({tag for tag in seen if seen.count(tag) > 1})
    points: dict[str | TagKey, int] = {tag: i for i, tag in enumerate(seen)}
    points |= {tag: len(seen) + k for k, tag in enumerate(joint)}
    known = [each for each in distances if {each.a, each.b} <= starts.keys() | points.keys()]
    pose, point = (
        np.array([[index.get(end, -1) for end in (each.a, each.b)] for each in known], dtype=np.int64).reshape(-1, 2)
        for index in (starts, points)
    )
    return Tape(pose, point, *(np.array([getattr(each, k) for each in known]) for k in ("distance_m", "sigma_m")))


def _at_delays(problem: JointProblem, values: Variables, noises: Sequence[Noise]) -> tuple[JointProblem, Variables]:
    """Return the problem with all motions composed at the present delays, and the values moved accordingly."""
    drives, poses = [], []
    for k, drive in enumerate(problem.drives):
        robot = drive.segment.run.robot
        own = slice(*problem.layout.first_pose[k : k + 2].tolist())
        index = problem.calibration.index(Owned(robot.robot_id, TIME_OFFSET)) if len(robot.camera_names) == 1 else 0
        there = drive.with_delay(float(values.calibration[index])) if index else drive
        drives.append(there)
        poses.append(earlier(values.poses[own], drive.velocity, there.delay_s - drive.delay_s))
    if all(a is b for a, b in zip(drives, problem.drives, strict=True)):
        return problem, values
    moved = JointProblem(drives, problem.calibration, noises, problem.places, by_pass=True, tape=problem.tape)
    moved.prior_weights = problem.prior_weights
    return moved, values._replace(poses=np.concatenate(poses))


@dataclass
class Estimate:
    """All drives: each alone, and the components."""

    alone: list[Alone]
    joints: list[Joint]


def estimate_jointly(
    segments: Sequence[Segment],
    prior: NoiseParameters = NoiseParameters(),
    distances: Sequence[MeasuredDistance] = (),
    stages: Stages | None = None,
    workers: Workers | None = None,
) -> Estimate:
    """Return the joint estimate of some segments.

    Args:
        segments: the segments.
        prior: noise before the drives were seen.
        distances: measured by a person.
        stages: notified of progress.
        workers: that share the drives.
    """
    stages, workers = stages or Stages(), workers or Workers()
    items, names = [(each, prior) for each in segments], [each.name for each in segments]
    alone = workers.map(_solve_alone, items, names, stages, "each drive alone")
    joints = []
    for group in place([each.places for each in alone], [len(each.drive.segment.observations) for each in alone]):
        with stages.stage("solving all runs together"):
            joints.append(solve_joint(sorted(group), alone, group, prior, distances))
    return Estimate(alone, joints)
