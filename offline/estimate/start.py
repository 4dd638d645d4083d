"""Start values of one drive: it grows by chunks, and where a chunk does not fit, hypotheses compete.

The motions of a drive may hide a turn that the wheels do not tell (lifted, pushed, a slip on the spot), and its first
map may lie in a local minimum. Each chunk may begin with such a turn, or be placed anew by pairs of tags; the least
cost wins.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.estimate.drive import Drive
from groundsbot.offline.estimate.kernels import Variables
from groundsbot.offline.estimate.likelihood import update
from groundsbot.offline.estimate.parameters import CalibrationModel, calibration_of
from groundsbot.offline.estimate.problem import JointProblem, Noise, places_of
from groundsbot.offline.measurements import TagKey

_CHUNK: Final = 25  # readings
_CHUNKS: Final = 60  # later chunks are this share of what there is
# Under the model a reading costs 1.5 on average with a standard deviation of 1.5; that 25 cost 4 more each is chance
# in none of a thousand drives.
_MOST_EXCESS: Final = 4.0
_LEAST_GAIN: Final = 3.0
_PLACE_SIGMA_M: Final = 0.2  # of the readings of a chunk that is placed as a whole
_N_PLACEMENTS: Final = 60
_N_ROUNDS: Final = 8
_MOST_GROWN: Final = 2000  # readings that a drive grows with; all are used at the end


@dataclass
class Alone:
    """One drive, solved alone in the frame of one of its poses."""

    drive: Drive
    problem: JointProblem
    values: Variables
    noise: Noise
    cost: float = 0.0

    @property
    def places(self) -> dict[TagKey, FloatArray]:
        """Position (2,) of each tag in the drive's frame."""
        return {own.tag: self.values.points[i] for i, own in enumerate(self.problem.layout.own)}


def solve_alone(drive: Drive, noise: Noise, default: Noise, n_rounds: int = _N_ROUNDS) -> Alone:
    """Solve a drive alone.

    Args:
        drive: the drive.
        noise: wide noise to grow with.
        default: noise before the drive was seen, for its fit.
        n_rounds: times that noise and solution are updated at the end.
    """
    growth = _Growth(drive.thin(_MOST_GROWN), noise)
    return growth.finish(drive, default, n_rounds)


class _Growth:
    """A drive that grows by chunks of readings."""

    def __init__(self, drive: Drive, noise: Noise) -> None:
        self.drive, self.noise = drive, noise
        self.calibration: CalibrationModel = calibration_of([drive])
        self.c = self.calibration.values
        self.poses = np.zeros((1, 3))
        self.places: dict[TagKey, FloatArray] = {}
        self.cost = 0.0
        self.n_solves = 0
        self._grow()

    def _grow(self) -> None:
        keyframe = self.drive.segment.observations.keyframe
        done, chunks = 0, 0
        while done < len(keyframe):
            end = min(len(keyframe), done + max(_CHUNK, done // _CHUNKS))
            n = int(keyframe[end - 1]) + 1
            end = int(np.searchsorted(keyframe, n))
            self._add_chunk(n, done, end)
            done, chunks = end, chunks + 1
            if chunks % 8 == 0:
                self._apply_delay()
            if chunks % 25 == 0:
                self._relocate(n)
        last = self.drive.n_poses
        problem, values = self._problem(last)
        values.poses[: len(self.poses)] = self.poses
        problem.reckon(values, len(self.poses) - 1, last)
        self._keep(problem, values)

    def _problem(self, n: int, held_pose: int | None = 0) -> tuple[JointProblem, Variables]:
        problem = JointProblem([self.drive.prefix(n)], self.calibration, [self.noise], held_pose=held_pose)
        points = np.array([self.places.get(own.tag, np.full(2, np.nan)) for own in problem.layout.own]).reshape(-1, 2)
        return problem, Variables(np.zeros((n, 3)), points, self.c.copy())

    def _keep(self, problem: JointProblem, values: Variables) -> None:
        self.poses, self.c = values.poses, values.calibration
        self.places = {own.tag: values.points[i] for i, own in enumerate(problem.layout.own)}

    def _minimise(self, problem: JointProblem, values: Variables, most_steps: int) -> tuple[Variables, float]:
        self.n_solves += 1
        found = problem.minimise(values, tolerance=0.5, most_steps=most_steps)
        return found.values, found.cost

    def _add_chunk(self, n: int, done: int, end: int) -> None:
        problem, values = self._problem(n)
        n_before = len(self.poses)
        values.poses[:n_before] = self.poses
        problem.reckon(values, n_before - 1, n)
        chunk = np.arange(done, end)
        known = ~np.isnan(values.points[problem.readings.point[chunk], 0])
        first = values._replace(poses=values.poses.copy(), points=values.points.copy())
        _place_new(problem, values)
        best, cost = self._minimise(problem, values, 3)
        if (cost - self.cost) / len(chunk) > _MOST_EXCESS and known.sum() >= 3:
            for start in self._hypotheses(problem, first, chunk[known], n_before - 1, n):
                there, other = self._minimise(problem, start, 6)
                if other < cost - _LEAST_GAIN:
                    best, cost = there, other
        self._keep(problem, best)
        self.cost = cost

    def _hypotheses(
        self, problem: JointProblem, values: Variables, chunk: IntArray, last: int, n: int
    ) -> list[Variables]:
        """Return start values with a turn, or a placement of the chunk, at its first pose or where it first misfits."""
        readings = problem.readings
        pose, point = readings.pose[chunk], readings.point[chunk]
        target = values.points[point]
        seen = places_of(readings, values)[chunk]
        here = values.poses[pose, :2]
        turned = se2.wrap_angle(_angle(target - here) - _angle(seen - here))
        off = np.flatnonzero(np.abs(turned) > 0.15)
        begins = sorted({max(last, 0), max(last, int(pose[off[0]]) - 1) if len(off) else max(last, 0)})
        found = []
        angles = {round(float(np.median(each)), 2) for each in (turned, turned[len(turned) // 2 :])}
        for angle in sorted(angles):
            if abs(angle) >= 0.05:
                for begin in begins:
                    found.append(_move(problem, values, begin, n, np.array([0.0, 0.0, angle])))
        placement = _placement(seen, target, point, len(found) + len(chunk))
        if placement is not None:
            for begin in begins:
                found.append(_move(problem, values, begin, n, placement, whole=True))
        for each in found:
            _place_new(problem, each)
        return found

    def _spread_to(self, whole: Drive) -> None:
        """Go on with all readings: poses between known ones by the motions from the one before."""
        at = np.searchsorted(whole.keyframes, self.drive.keyframes)
        whole = whole.with_delay(self.drive.delay_s)
        known, self.drive = self.poses, whole
        problem, values = self._problem(whole.n_poses)
        values.poses[at] = known
        for k, begin in enumerate(at.tolist()):
            end = int(at[k + 1]) if k + 1 < len(at) else whole.n_poses
            if end - begin > 1:
                problem.reckon(values, begin, end)
        _place_new(problem, values)  # tags with a single reading may have been left out
        self._keep(problem, values)

    def _apply_delay(self) -> None:
        """Compose the motions anew at the present delay."""
        moved = _with_delay(self.drive, self.calibration, self.c)
        if moved is not self.drive:
            late_s = moved.delay_s - self.drive.delay_s
            n = len(self.poses)
            self.poses = earlier(self.poses, self.drive.velocity[:n], late_s)
            self.drive = moved

    def _relocate(self, n: int) -> None:
        problem, values = self._problem(n)
        values.poses[:] = self.poses
        values = relocate(problem, values)
        best, self.cost = self._minimise(problem, values, 5)
        self._keep(problem, best)

    def finish(self, whole: Drive, default: Noise, n_rounds: int) -> Alone:
        """Return the whole drive solved under its own noise."""
        if whole.n_poses != self.drive.n_poses:
            self._spread_to(whole)
        noise, cost = self.noise, 0.0
        tilt: FloatArray | None = None
        problem: JointProblem | None = None
        n = self.drive.n_poses
        values = None
        for _ in range(n_rounds):
            self._apply_delay()
            self.noise = noise
            problem, values = self._problem(n, None)
            values.poses[:] = self.poses
            values = problem.minimise(problem.centre(values), tilt, 0.1, 8).values
            found = problem.minimise(relocate(problem, values), tilt, 0.1, 4)
            self._keep(problem, found.values)
            values, cost = found.values, found.cost
            factor = found.factor if found.converged and found.factor else problem.factor_at(values)
            updated = update(problem, values, factor, [default])
            (noise,) = updated.noises
            before: FloatArray = problem.measure if tilt is None else tilt
            tilt = 0.5 * (updated.tilt + before)
            if updated.change < 0.3:
                break
        if problem is None or values is None:
            problem, values = self._problem(n)
            values.poses[:] = self.poses
        return Alone(self.drive, problem, values, noise, cost)


def relocate(problem: JointProblem, values: Variables) -> Variables:
    """Return the values with points moved to where most of their readings put them, where that costs less."""
    seen = places_of(problem.readings, values)
    points = values.points.copy()
    order = np.argsort(problem.readings.point, kind="stable")
    ends = np.searchsorted(problem.readings.point[order], np.arange(len(points) + 1))
    for k in range(len(problem.layout.own)):
        own = seen[order[ends[k] : ends[k + 1]]]
        if len(own) < 3:
            continue
        middle = np.median(own, axis=0)
        if np.median(np.hypot(*(own - middle).T)) > 0.3:
            tried = own[:: max(1, len(own) // 40)]
            sums = [np.minimum(np.hypot(*(own - each).T), 0.5).sum() for each in tried]
            middle = tried[int(np.argmin(sums))]
        if _spread(own, middle) < _spread(own, points[k]) - 3.0:
            points[k] = middle
    return values._replace(points=points)


def _spread(seen: FloatArray, place: FloatArray) -> float:
    return float(np.log1p(((seen - place) ** 2).sum(axis=1) / 0.04).sum())


def _place_new(problem: JointProblem, values: Variables) -> None:
    """Set points without a position to the median of their first five readings."""
    missing = np.isnan(values.points[:, 0])
    if not missing.any():
        return
    seen = places_of(problem.readings, values)
    for k in np.flatnonzero(missing):
        own = seen[problem.readings.point == k][:5]
        values.points[k] = np.median(own, axis=0) if len(own) else 0.0


def _move(
    problem: JointProblem, values: Variables, begin: int, n: int, by: FloatArray, *, whole: bool = False
) -> Variables:
    """Return values with poses from `begin` on turned, or with the whole of them moved by T_map_map."""
    poses = values.poses.copy()
    if whole:
        poses[begin] = se2.compose(by, poses[begin])
    else:
        poses[begin, 2] += by[2]
    found = values._replace(poses=poses, points=values.points.copy(), calibration=values.calibration.copy())
    problem.reckon(found, begin, n)
    return found


def _placement(seen: FloatArray, target: FloatArray, point: IntArray, seed: int) -> FloatArray | None:
    """Return T (3,) that puts most readings onto their points, from pairs of different tags; None without any."""
    if len(set(point.tolist())) < 2:
        return None
    rng = np.random.default_rng(seed)
    best, found = 2.5, None
    for _ in range(_N_PLACEMENTS):
        i, j = rng.choice(len(point), 2, replace=False)
        if point[i] == point[j]:
            continue
        T = rigid(seen[[i, j]], target[[i, j]])
        score = float(np.exp(-((se2.apply(T, seen) - target) ** 2).sum(axis=1) / (2.0 * _PLACE_SIGMA_M**2)).sum())
        if score > best:
            best, found = score, T
    return found


def rigid(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return T (3,) such that T a is nearest to b in the sense of least squares, for points (n, 2)."""
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    A, B = a - centre_a, b - centre_b
    theta = np.arctan2((A[:, 0] * B[:, 1] - A[:, 1] * B[:, 0]).sum(), (A * B).sum())
    turn = np.array([0.0, 0.0, theta])
    return np.append(centre_b - se2.apply(turn, centre_a), theta)


def _angle(vectors: FloatArray) -> FloatArray:
    return np.arctan2(vectors[:, 1], vectors[:, 0])


def earlier(poses: FloatArray, velocity: FloatArray, late_s: float) -> FloatArray:
    """Return poses (n, 3) moved back along their velocities by a time, but for the first."""
    moved = se2.compose(poses, se2.exp(-late_s * velocity))
    moved[0] = poses[0]
    return np.asarray(np.column_stack([moved[:, :2], poses[:, 2] + se2.wrap_angle(moved[:, 2] - poses[:, 2])]))


def _with_delay(drive: Drive, calibration: CalibrationModel, c: FloatArray) -> Drive:
    """Return the drive with its motions at the delay of its only camera."""
    robot = drive.segment.run.robot
    if len(robot.camera_names) != 1:
        return drive
    from groundsbot.calib.robot import TIME_OFFSET
    from groundsbot.offline.estimate.parameters import Owned

    index = calibration.index(Owned(robot.robot_id, TIME_OFFSET))
    return drive.with_delay(float(c[index])) if index else drive
