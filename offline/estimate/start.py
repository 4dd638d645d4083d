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
# Under the model a reading costs 1.5 on average with a standard deviation of 1.5: that 25 cost 2.4 each is chance in
# one of a thousand chunks, or in fewer, since the noise to grow with is wide.
_MOST_EXCESS: Final = 2.4
_LEAST_GAIN: Final = 3.0
_PLACE_SIGMA_M: Final = 0.2  # of readings of a chunk that is placed as a whole, and of passes about their tag
_OFF_RAD: Final = 0.15
_OFF_M: Final = 0.5
_LEAST_TURN_RAD: Final = 0.05
_N_PLACEMENTS: Final = 60
_N_ROUNDS: Final = 8
_N_TRIED: Final = 40
_N_PURSUED: Final = 3  # hypotheses: those of least cost after two steps
_CLOSE: Final = 1.0  # in standard errors of the noise, which all drives together find better
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
    thin = drive.thin(_MOST_GROWN)
    grown = [_Growth(thin, noise, by_pass=by_pass) for by_pass in (True, False)]
    return min(grown, key=lambda each: each.cost).finish(drive, default, n_rounds)


class _Growth:
    """A drive that grows by chunks of readings.

    Either with a place of each pass, so that any number of misread ids in a row has one cause and is soon believed, or
    with an error of each reading, so that many in a row are not. One is right where an id is misread for long, the
    other where the robot was lifted or slipped early. The cost, with a place of each pass, tells at the end.
    """

    def __init__(self, drive: Drive, noise: Noise, *, by_pass: bool) -> None:
        self.drive, self.noise, self.by_pass = drive, noise, by_pass
        self.calibration: CalibrationModel = calibration_of([drive])
        self.c = self.calibration.values
        self.poses = np.zeros((1, 3))
        self.places: dict[TagKey, FloatArray] = {}
        self.of_pass: dict[int, FloatArray] = {}
        self.cost = 0.0
        self._grow()

    def _grow(self) -> None:
        keyframe = self.drive.segment.observations.keyframe
        before, done, chunks = 0, 0, 0
        while done < len(keyframe):
            end = min(len(keyframe), done + max(_CHUNK, done // _CHUNKS))
            n = int(keyframe[end - 1]) + 1
            end = int(np.searchsorted(keyframe, n))
            self._add_chunk(n, before, done, end)
            before, done, chunks = done, end, chunks + 1
            if chunks % 8 == 0:
                self._apply_delay()
            if chunks % 25 == 0:
                self._relocate(n)
        last = self.drive.n_poses
        problem, values = self._problem(last)
        values.poses[: len(self.poses)] = self.poses
        problem.reckon(values, len(self.poses) - 1, last)
        self._keep(problem, values)
        if not self.by_pass:
            self.by_pass = True
            problem, values = self._problem(last)
            values.poses[:] = self.poses
            self._keep(problem, _place_passes(problem, values))
        self._relocate(last)

    def _problem(self, n: int, held_pose: int | None = 0) -> tuple[JointProblem, Variables]:
        """Return the problem of the first n poses, and what is known of its values; points that are not are NaN."""
        drive = self.drive.prefix(n)
        problem = JointProblem([drive], self.calibration, [self.noise], held_pose=held_pose, by_pass=self.by_pass)
        unknown = np.full(2, np.nan)
        points = [self.places.get(own.tag, unknown) for own in problem.layout.own]
        if self.by_pass:
            points += [self.of_pass.get(number, unknown) for number in np.unique(drive.passes).tolist()]
        return problem, Variables(np.zeros((n, 3)), np.array(points).reshape(-1, 2), self.c.copy())

    def _keep(self, problem: JointProblem, values: Variables) -> None:
        self.poses, self.c = values.poses, values.calibration
        n = len(problem.layout.own)
        self.places = {own.tag: at for own, at in zip(problem.layout.own, values.points[:n], strict=True)}
        if self.by_pass:
            self.of_pass = dict(zip(np.unique(problem.drives[0].passes).tolist(), values.points[n:], strict=True))

    def _minimise(self, problem: JointProblem, values: Variables, most_steps: int) -> tuple[Variables, float]:
        found = problem.minimise(_with_new_places(problem, values), tolerance=0.5, most_steps=most_steps)
        return found.values, found.cost

    def _add_chunk(self, n: int, before: int, done: int, end: int) -> None:
        """Add readings `done` to `end` - 1, with the poses up to n - 1; those from `before` on may be moved anew."""
        problem, values = self._problem(n)
        n_before = len(self.poses)
        values.poses[:n_before] = self.poses
        problem.reckon(values, n_before - 1, n)
        best, cost = self._minimise(problem, values, 3)
        is_known = ~np.isnan(values.points[_own_of(problem), 0])
        known = done + np.flatnonzero(is_known[done:end])
        if (cost - self.cost) / (end - done) > _MOST_EXCESS and len(known) >= 3:
            recent = before + np.flatnonzero(is_known[before:end])
            starts = self._hypotheses(problem, values, recent, known, n_before - 1, n)
            tried = sorted((self._minimise(problem, each, 2) for each in starts), key=lambda each: each[1])
            for start, _ in tried[:_N_PURSUED]:
                there, other = self._minimise(problem, start, 5)
                if other < cost - _LEAST_GAIN:
                    best, cost = there, other
            if self.by_pass:
                best, cost = self._minimise(problem, relocate(problem, best), 3)
        self._keep(problem, best)
        self.cost = cost

    def _hypotheses(
        self, problem: JointProblem, values: Variables, recent: IntArray, chunk: IntArray, last: int, n: int
    ) -> list[Variables]:
        """Return start values with another cause for what is off each.

        A turn that the wheels do not tell, or a placement of what follows, at the first pose of the chunk or where
        readings are first off; a turn anywhere before; or readings of another tag, or of none.
        """
        pose, own = problem.readings.pose, _own_of(problem)
        target = values.points[own]
        seen = places_of(problem.readings, values)
        here = values.poses[pose, :2]
        turned = se2.wrap_angle(_angle(target - here) - _angle(seen - here))
        off_m = np.hypot(*(seen - target).T)
        off = recent[(np.abs(turned[recent]) > _OFF_RAD) | (off_m[recent] > _OFF_M)]
        begins = sorted({max(last, 0), *([max(int(pose[off[0]]) - 1, 0)] if len(off) else [])})
        turns = set[tuple[int, float]]()
        for group in (chunk, chunk[len(chunk) // 2 :], off):
            if len(group):
                turns |= {(begin, round(float(np.median(turned[group])), 2)) for begin in begins}
                turns |= _turns_anywhere(values.poses[: pose[group[0]] + 1, :2], seen[group], target[group])
        found = [
            _move(problem, values, begin, n, np.array([0.0, 0.0, angle]))
            for begin, angle in sorted(turns)
            if abs(angle) >= _LEAST_TURN_RAD
        ]
        placement = _placement(seen[chunk], target[chunk], own[chunk], len(found) + len(chunk))
        if placement is not None:
            found += [_move(problem, values, begin, n, placement, whole=True) for begin in begins]
        if not self.by_pass:
            return found
        strange = [chunk[own[chunk] == k] for k in np.unique(own[chunk])]
        strange = [each for each in strange if np.median(off_m[each]) > _OFF_M]
        for which in [*strange, *([np.concatenate(strange)] if len(strange) > 1 else [])]:
            points = values.points.copy()
            for k in np.unique(problem.readings.point[which]):
                points[k] = np.median(seen[which[problem.readings.point[which] == k]], axis=0)
            found.append(values._replace(points=points))
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
        self._keep(problem, _with_new_places(problem, values))  # tags with a single reading may have been left out

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
        best, self.cost = self._minimise(problem, relocate(problem, values), 5)
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
            weights = None if problem is None else problem.prior_weights
            problem, values = self._problem(n, None)
            values.poses[:] = self.poses
            if weights is not None:
                problem.prior_weights = weights
            values = problem.minimise(problem.centre(values), tilt, 0.1, 8).values
            if weights is None:
                problem.hold_priors(values)
            found = problem.minimise(relocate(problem, values), tilt, 0.1, 4)
            self._keep(problem, found.values)
            values, cost = found.values, found.cost
            factor = found.factor if found.converged and found.factor else problem.factor_at(values)
            updated = update(problem, values, factor, [default])
            (noise,) = updated.noises
            before: FloatArray = problem.measure if tilt is None else tilt
            tilt = 0.5 * (updated.tilt + before)
            if updated.change < _CLOSE:
                break
        if problem is None or values is None:
            problem, values = self._problem(n)
            values.poses[:] = self.poses
        return Alone(self.drive, problem, values, noise, cost)


def relocate(problem: JointProblem, values: Variables) -> Variables:
    """Return the values with own places moved to where most of their passes, or readings, are, if that costs less.

    A pass at the place of another tag counts half: it may be a misreading of that.
    """
    points, n_own = values.points.copy(), len(problem.layout.own)
    if len(problem.layout.of_pass):
        places, of = values.points[n_own:], problem.layout.of_pass
    else:
        places, of = places_of(problem.readings, values), problem.readings.point
    away = np.hypot(*(places[:, None] - points[:n_own]).transpose(2, 0, 1))
    away[np.arange(len(away)), of] = np.inf
    weights = np.where(away.min(axis=1, initial=np.inf) < _PLACE_SIGMA_M, 0.5, 1.0)
    for k in range(n_own):
        own, weight = places[of == k], weights[of == k]
        if len(own) < 3:
            continue
        tried = own[:: max(1, len(own) // _N_TRIED)]
        middle = tried[int(np.argmin([_spread(own, weight, each) for each in tried]))]
        if _spread(own, weight, middle) < _spread(own, weight, points[k]) - _LEAST_GAIN:
            points[k] = middle
    return values._replace(points=points)


def _spread(places: FloatArray, weights: FloatArray, place: FloatArray) -> float:
    return float(weights @ np.log1p(((places - place) ** 2).sum(axis=1) / _PLACE_SIGMA_M**2))


def _own_of(problem: JointProblem) -> IntArray:
    """Return (M,) the own place of each reading."""
    point, n_own = problem.readings.point, len(problem.layout.own)
    return np.asarray(problem.layout.of_pass[point - n_own]) if len(problem.layout.of_pass) else point


def _place_passes(problem: JointProblem, values: Variables) -> Variables:
    """Return the values with each pass where its readings put it."""
    points, point = values.points.copy(), problem.readings.point
    seen = places_of(problem.readings, values)
    for k in np.unique(point):
        points[k] = np.median(seen[point == k], axis=0)
    return values._replace(points=points)


def _with_new_places(problem: JointProblem, values: Variables) -> Variables:
    """Return the values with a place for each point: own ones by the median of their first five readings."""
    points, n_own = values.points.copy(), len(problem.layout.own)
    missing = np.flatnonzero(np.isnan(points[:n_own, 0]))
    if len(missing):
        seen, own = places_of(problem.readings, values), _own_of(problem)
        for k in missing:
            first = seen[own == k][:5]
            points[k] = np.median(first, axis=0) if len(first) else 0.0
    of_pass = points[n_own:]
    points[n_own:] = np.where(np.isnan(of_pass), points[problem.layout.of_pass], of_pass)
    return values._replace(points=points)


def _move(
    problem: JointProblem, values: Variables, begin: int, n: int, by: FloatArray, *, whole: bool = False
) -> Variables:
    """Return values with poses after `begin` by motions from it, turned by a turn or moved as a whole by T_map_map."""
    poses, points = values.poses.copy(), values.points.copy()
    if whole:
        poses[begin] = se2.compose(by, poses[begin])
    else:
        poses[begin, 2] += by[2]
    # Passes after it are at their tags again, and tags that were first seen after it where they are seen then.
    is_after = problem.readings.pose > begin
    points[problem.readings.point[is_after]] = np.nan
    points[np.setdiff1d(_own_of(problem)[is_after], _own_of(problem)[~is_after])] = np.nan
    found = values._replace(poses=poses, points=points)
    problem.reckon(found, begin, n)
    return found


def _turns_anywhere(poses_m: FloatArray, seen: FloatArray, target: FloatArray) -> set[tuple[int, float]]:
    """Return poses, and turns there, after which most readings (k, 2) are nearest to their points (k, 2).

    Turns at one place differ by what is seen from there alone: the first and the last are among those returned.
    """
    a, b = seen - poses_m[:, None], target - poses_m[:, None]
    angle = np.median(se2.wrap_angle(_angle(b.reshape(-1, 2)) - _angle(a.reshape(-1, 2))).reshape(a.shape[:2]), axis=1)
    turn = np.repeat(np.column_stack([np.zeros((len(angle), 2)), angle]), a.shape[1], axis=0)
    off_m = np.median(np.hypot(*(se2.apply(turn, a.reshape(-1, 2)) - b.reshape(-1, 2)).T).reshape(a.shape[:2]), axis=1)
    best = np.flatnonzero(off_m < off_m.min() + 0.5 * _PLACE_SIGMA_M)
    return {(int(m), round(float(angle[m]), 2)) for m in (best[0], int(np.argmin(off_m)), best[-1])}


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
