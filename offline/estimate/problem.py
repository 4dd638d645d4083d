"""The joint problem of some drives: variables, factors, order of elimination, and the minimum of its cost."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.estimate.drive import (
    Drive,
    linear_of_readings,
    motion_variances,
    reading_variances,
    wheel_jacobian,
)
from groundsbot.offline.estimate.kernels import (
    MotionArrays,
    ReadingArrays,
    Ties,
    Variables,
    add_motions,
    add_readings,
    add_ties,
)
from groundsbot.offline.estimate.order import nodes_of
from groundsbot.offline.estimate.parameters import (
    CalibrationModel,
    calibration_of,
    reading_names,
    wheel_names,
)
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import (
    Damping,
    EliminationFronts,
    FrontalSystem,
    FrontFactor,
    Normal,
    NotPositiveError,
    build_fronts,
    parameter_of_scale,
)

# Degrees of freedom of the Student-t distributions. 4 has a finite variance and tails in which an error of ten sigmas
# is one in a few thousand; 2, for places, none: a tag that was moved pulls nothing.
NU: Final = 4.0
NU_PLACES: Final = 2.0
_MOST_STEPS: Final = 60
_MOST_SCALED: Final = 0.3  # change of the logarithm of a scale in one step
_SHARES: Final = (1.0, 0.3, 0.09, 0.027)  # of a step, tried in turn
LEAST_DAMPING: Final = 1e-11  # of the diagonal: keeps what nothing determines from being singular in rounding
_LEAST_INFORMATION: Final = 1e-9  # where nothing determines a variable at all
_LEAST_MOTION: Final = 1e-4  # m and rad: no wheel reading is finer


@dataclass
class Noise:
    """Noise of one robot: scales of its motions (4,) and of its readings by name."""

    motion: FloatArray
    reading: dict[str, float]

    def copy(self) -> "Noise":
        """Return a copy."""
        return Noise(self.motion.copy(), dict(self.reading))


class Own(NamedTuple):
    """A drive's own place of a tag."""

    drive: int
    tag: TagKey


@dataclass
class PlaceScales:
    """Scales of the places of a drive about the joint ones, and of those of a pass about the drive's, in m."""

    of_drive_m: float = 0.01
    of_pass_m: float = 0.02


@dataclass
class Layout:
    """Which variable is what.

    Attributes:
        first_pose: (D + 1,) first pose of each drive.
        own: own places, the first points.
        joint: tags with a joint place, the points after them.
        tie: (M, 2) own and joint point of each tie.
        of_pass: (N,) own place that each place of a pass belongs to; these are the last points.
        reading: (M,) point of each reading.
    """

    first_pose: IntArray
    own: list[Own]
    joint: list[TagKey]
    tie: IntArray
    of_pass: IntArray
    reading: IntArray

    @property
    def n_places(self) -> int:
        """Number of own and joint places, the points before those of passes."""
        return len(self.own) + len(self.joint)

    @property
    def n_points(self) -> int:
        """Number of points."""
        return self.n_places + len(self.of_pass)


class Tape(NamedTuple):
    """Distances measured by a person between points or poses, with tails as everything else.

    Attributes:
        pose: (M, 2) pose at each end, -1 where it is a point.
        point: (M, 2) point at each end, -1 where it is a pose.
        distance_m, sigma_m: (M,).
    """

    pose: IntArray
    point: IntArray
    distance_m: FloatArray
    sigma_m: FloatArray

    def linearise(self, values: Variables) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals (M,) and derivatives (M, 7) by both places, their scales and that of the map."""
        of_pose, of_point = values.poses[self.pose, :2], values.points[self.point]
        ends = np.where(self.pose[..., None] >= 0, of_pose, of_point)
        apart = ends[:, 1] - ends[:, 0]
        length_m = np.maximum(np.hypot(*apart.T), 1e-6)
        by_end = (apart / (length_m * self.sigma_m)[:, None])[:, None, :] * np.array([-1.0, 1.0])[None, :, None]
        by_stretch = (by_end * ends).sum(axis=2)
        by_all = by_stretch.sum(axis=1, keepdims=True)
        J = np.concatenate([by_end.reshape(-1, 4), by_stretch, by_all], axis=1)
        return (length_m - self.distance_m) / self.sigma_m, J


NO_TAPE: Final = Tape(np.zeros((0, 2), dtype=np.int64), np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))


class SolvedProblem(NamedTuple):
    """Where a minimisation ended."""

    values: Variables
    cost: float
    factor: FrontFactor | None
    converged: bool
    n_linearisations: int


class JointProblem:
    """Poses, own and joint places, and calibration of some drives, with all their factors.

    One pose is held, at the origin.
    """

    def __init__(
        self, drives: Sequence[Drive], calibration: CalibrationModel | None = None, noises: Sequence[Noise] = (),
        places: PlaceScales = PlaceScales(), held_pose: int | None = None, *, by_pass: bool = False,
        tape: Tape = NO_TAPE,
    ) -> None:  # fmt: skip
        self.drives = list(drives)
        self.calibration = calibration_of(drives) if calibration is None else calibration
        self.places, self.tape = places, tape
        self.layout = _layout(drives, by_pass=by_pass)
        self.motions = _motions(drives, self.calibration, self.layout)
        self.readings = _readings(drives, self.calibration, self.layout)
        self.prior_parameters, self.prior_rows, self.prior_means = self.calibration.arrays()
        self.map_scale = self.calibration.map_scale
        self.prior_weights = np.ones(len(self.prior_means))
        self.held_pose = self._middle_pose() if held_pose is None else held_pose
        self.noises = list(noises)
        if noises:
            self.set_noise(noises, places)

    def _middle_pose(self) -> int:
        """Return the pose of the middle reading of the drive with most: well tied to the map, as first poses are not.

        The frame is held there: at a pose that a slip or a long way parts from the map, the least step would turn all.
        """
        drive_of = np.searchsorted(self.layout.first_pose, self.readings.pose, side="right") - 1
        if not len(drive_of):
            return 0
        own = np.sort(self.readings.pose[drive_of == np.bincount(drive_of).argmax()])
        return int(own[len(own) // 2])

    def centre(self, values: Variables) -> Variables:
        """Return the values in the frame of the pose that is held, which must be at the origin."""
        T = se2.inverse(values.poses[self.held_pose])
        return transform(values, T)

    # --- noise

    @cached_property
    def motion_units(self) -> FloatArray:
        """(4, M, 3) variances of motions for unit noise."""
        return np.concatenate([motion_variances(each.extents) for each in self.drives], axis=1)

    @cached_property
    def reading_units(self) -> list[tuple[tuple[str, ...], FloatArray]]:
        """Names and (K, M, 2, 2) variances for unit noise of each drive's readings."""
        return [reading_variances(each) for each in self.drives]

    def set_noise(self, noises: Sequence[Noise], places: PlaceScales) -> None:
        """Set the scales of all factors from the noise of each drive."""
        self.noises, self.places = list(noises), places
        scales = np.concatenate(
            [
                np.tile(each.motion, (len(drive.segment.odometry), 1))
                for each, drive in zip(noises, self.drives, strict=True)
            ]
        )
        variance = np.einsum("mk,kmr->mr", scales**2, self.motion_units)
        self.motions = self.motions._replace(sigma=np.sqrt(variance + _LEAST_MOTION**2))
        whitening = []
        for noise, (names, units) in zip(noises, self.reading_units, strict=True):
            squares = np.array([noise.reading[name] for name in names]) ** 2
            whitening.append(_whitening(np.tensordot(squares, units, 1)))
        self.readings = self.readings._replace(whitening=np.concatenate(whitening))

    @property
    def joint_ties(self) -> Ties:
        """Ties of own places to joint ones."""
        own, joint = self.layout.tie.T
        n = len(own)
        unit = np.full(n, self.map_scale)
        sigma_m = np.full(n, self.places.of_drive_m)
        return Ties(own.copy(), joint.copy(), self.distance_of_points[own], unit, np.zeros(n), sigma_m)

    @property
    def pass_ties(self) -> Ties:
        """Ties of places of passes to own ones."""
        of_pass, n = self.layout.of_pass, len(self.layout.of_pass)
        at = self.layout.n_places + np.arange(n)
        unit = self.distance_of_points[at]
        return Ties(at, of_pass, unit, unit, np.ones(n), np.full(n, self.places.of_pass_m))

    @cached_property
    def distance_of_poses(self) -> IntArray:
        """(P,) ln distance that stretches each pose."""
        own = [self.calibration.index(wheel_names(each)[0]) for each in self.drives]
        return np.repeat(np.array(own, dtype=np.int64), np.diff(self.layout.first_pose))

    @cached_property
    def distance_of_points(self) -> IntArray:
        """(Q,) ln distance that stretches each point; 0, which is fixed, for joint places."""
        own = [self.calibration.index(wheel_names(self.drives[each.drive])[0]) for each in self.layout.own]
        known = np.array([*own, *[0] * len(self.layout.joint)], dtype=np.int64)
        return np.concatenate([known, known[self.layout.of_pass]])

    # --- structure

    @cached_property
    def columns(self) -> tuple[IntArray, IntArray, IntArray, int]:
        """Columns of poses (P, 3), points (Q, 2) and calibration (C,), -1 where held, and their number."""
        n_poses, n_points = int(self.layout.first_pose[-1]), self.layout.n_points
        poses = np.arange(3 * n_poses).reshape(-1, 3)
        poses[self.held_pose :] -= 3
        poses[self.held_pose] = -1
        n = 3 * n_poses - 3
        points = n + np.arange(2 * n_points).reshape(-1, 2)
        n += 2 * n_points
        free = np.arange(len(self.calibration.names)) > 0
        calibration = np.where(free, n + np.cumsum(free) - 1, -1)
        return poses, points, calibration, n + int(free.sum())

    @cached_property
    def order(self) -> EliminationFronts:
        """Order of elimination with the places of all factors."""
        poses, points, calibration, n = self.columns
        lengths = np.diff(self.layout.first_pose).tolist()
        layout = self.layout
        at = np.arange(len(points))
        is_joint = (at >= len(layout.own)) & (at < layout.n_places)
        # An own place is on the path of its passes to the root.
        pose, point = self.readings.pose, self.readings.point
        if len(layout.of_pass):
            pose, point = np.tile(pose, 2), np.concatenate([point, layout.of_pass[point - layout.n_places]])
        pose_node, point_node, parent = nodes_of(lengths, pose, point, is_joint)
        root = len(parent) - 1
        node_of = np.full(n, root, dtype=np.int64)
        for columns, nodes in ((poses, pose_node[:, None]), (points, point_node[:, None])):
            nodes = np.broadcast_to(nodes, columns.shape)
            node_of[columns[columns >= 0]] = nodes[columns >= 0]
        for columns, ends in ((poses, self.tape.pose), (points, self.tape.point)):
            node_of[columns[ends[ends >= 0]]] = root
        first = self.motions.first
        readings = self.readings
        kinds = (
            np.column_stack([poses[first], poses[first + 1], calibration[self.motions.parameters]]),
            np.column_stack([poses[readings.pose], points[readings.point], calibration[readings.parameters]]),
            *(
                np.column_stack([points[ties.case], points[ties.general], self.scale_columns(ties.parameter)[0]])
                for ties in (self.joint_ties, self.pass_ties)
            ),
            calibration[self.prior_parameters],
            self._tape_columns,
        )
        return build_fronts(n, node_of, parent, kinds)

    @property
    def _tape_columns(self) -> IntArray:
        poses, points, _, _ = self.columns
        is_pose = self.tape.pose >= 0
        ends = np.where(is_pose[..., None], poses[self.tape.pose, :2], points[self.tape.point])
        stretch = np.where(is_pose, self.distance_of_poses[self.tape.pose], self.distance_of_points[self.tape.point])
        own, of_all = self.scale_columns(stretch)
        return np.concatenate([ends.reshape(-1, 4), own, of_all[:, :1]], axis=1)

    def scale_columns(self, parameter: IntArray) -> tuple[IntArray, IntArray]:
        """Return the columns of two variables that stretch something with a ln distance (0 for what is joint).

        The first is the ln distance, -1 where that is the stretch itself or there is none; the second is the stretch.
        """
        calibration = self.columns[2]
        own = np.where(parameter == self.map_scale, -1, calibration[parameter])
        return own, np.full_like(own, calibration[self.map_scale])

    # --- cost

    def system(
        self, values: Variables, *, is_whole: bool = True, is_information: bool = False
    ) -> tuple[FrontalSystem, float]:
        """Return the normal equations at some values, and the cost.

        Args:
            values: the values.
            is_whole: with the matrices, not only the gradient.
            is_information: with the Fisher information in place of the weights of the last iteration, which are one on
                average: that of d components with a Student-t distribution is (nu + d) / (nu + d + 2) of the normal
                one's (Lange, Little and Taylor 1989).
        """
        by_one, by_two, of_places = (
            (nu + d) / (nu + d + 2.0) if is_information else 1.0 for nu, d in ((NU, 1), (NU, 2), (NU_PLACES, 2))
        )
        system = self.order.empty(is_whole=is_whole)
        kinds = self.order.kinds
        cost = add_motions(self.motions, kinds[0], values, NU, system, by_one)
        cost += add_readings(self.readings, kinds[1], values, NU, system, by_two)
        cost += add_ties(self.joint_ties, kinds[2], values, NU_PLACES, system, of_places)
        cost += add_ties(self.pass_ties, kinds[3], values, NU, system, by_two)
        e = self._prior_errors(values)
        w = by_one * self.prior_weights
        cost += float((0.5 * self.prior_weights * e**2).sum())
        normal = w[:, None, None] * self.prior_rows[:, :, None] * self.prior_rows[:, None, :]
        self.order.add(system, 4, [Normal(normal, (w * e)[:, None] * self.prior_rows)])
        e, J = self.tape.linearise(values)
        w = by_one * (NU + 1.0) / (NU + e**2)
        cost += float((0.5 * (NU + 1.0) * np.log1p(e**2 / NU)).sum())
        normal = w[:, None, None] * J[:, :, None] * J[:, None, :]
        self.order.add(system, 5, [Normal(normal, (w * e)[:, None] * J)])
        cost += self._add_spread(system, values)
        return system, cost

    @cached_property
    def measure(self) -> FloatArray:
        """(n,) gradient of minus the logarithm of the volume of poses and points by the variables, in metres.

        Motions are given in metres of the wheels, so poses are of unit volume there but for a free start; places are
        so in metres of the map.
        """
        found = np.zeros(self.columns[3])
        if len(self.in_map) < 2:
            return found
        first = int(np.searchsorted(self.layout.first_pose, self.held_pose, side="right")) - 1
        of_start = np.delete(self.distance_of_poses[self.layout.first_pose[:-1]], first)
        of_places = self.distance_of_points[: self.layout.n_places]
        own, of_all = self.scale_columns(np.concatenate([of_places, of_start]))
        is_tied = np.isin(np.arange(len(own)), self.layout.tie[:, 0])  # a tie's density is in the stretch's metres
        for column in np.concatenate([own, of_all[~is_tied]]).tolist():
            if column >= 0:
                found[column] -= 2.0
        return found

    @cached_property
    def in_map(self) -> IntArray:
        """The points that are places of the map: joint ones, and own ones of tags that no other drive sees."""
        return np.setdiff1d(np.arange(self.layout.n_places), self.layout.tie[:, 0])

    @cached_property
    def free_parameters(self) -> IntArray:
        """Columns of the calibration."""
        columns = self.columns[2]
        return np.asarray(columns[columns >= 0])

    def _add_spread(self, system: FrontalSystem, values: Variables) -> float:
        """Add the prior on the places of the map; return its cost.

        They are normally distributed about some centre with a spread of any magnitude, each as likely as the other,
        and so are the centre and the other drives' starts in units of that spread: the density is the sum of squares to
        the power of minus their number. A density that is flat in metres instead would prefer large maps.
        """
        k = len(self.in_map) + len(self.drives)
        if len(self.in_map) < 2:
            return 0.0
        points = values.points[self.in_map]
        away = points - points.mean(axis=0)
        total = float((away**2).sum()) + 1e-9
        columns = self.columns[1][self.in_map]
        gradient = 2.0 * (k - 1) / total * away
        system.gradient[columns] += gradient
        for stretch in self.scale_columns(self.distance_of_points[self.in_map]):
            of = stretch >= 0
            np.add.at(system.gradient, stretch[of], (gradient * points).sum(axis=1)[of])
        if len(system.entries):
            system.entries[self.order.diagonal[columns]] += 2.0 * (k - 1) / total
        return (k - 1) * float(np.log(total))

    def _prior_errors(self, values: Variables) -> FloatArray:
        known = slice(0, -1)  # the scale of the map has no value of its own
        return np.asarray((self.prior_rows * values.calibration[self.prior_parameters])[:, known].sum(axis=1)) - (
            self.prior_means
        )

    def hold_priors(self, values: Variables) -> None:
        """Set the weights of the heavy-tailed priors on the calibration to those at some values."""
        self.prior_weights = (NU + 1.0) / (NU + self._prior_errors(values) ** 2)

    def start(self) -> Variables:
        """Return values by dead reckoning, with all points at the origin."""
        n_points = self.layout.n_points
        poses = np.concatenate([each.segment.odometry.dead_reckon() for each in self.drives])
        return Variables(poses, np.zeros((n_points, 2)), self.calibration.values)

    def minimise(
        self, values: Variables, tilt: FloatArray | None = None, tolerance: float = 1e-3, most_steps: int = _MOST_STEPS
    ) -> SolvedProblem:
        """Minimise the cost, plus tilt (n,) times the change of the variables, by damped Gauss-Newton steps.

        The weights of priors on the calibration are held as they are: a line against a heavy tail has no minimum.
        Without a tilt they are first set to those at the given values, and the tilt is that of the volume of the
        variables, which the prior on places needs.

        Ends when the predicted decrease is below the tolerance.
        """
        n = self.columns[3]
        scales = np.concatenate(self.scale_columns(np.unique(self.distance_of_poses)))
        scales = scales[scales >= 0]
        total = np.zeros(n)
        if tilt is None:
            tilt = self.measure
            self.hold_priors(values)
        damping = Damping()
        system, cost = self.system(values)
        n_linearisations = 1
        factor: FrontFactor | None = None
        for _ in range(most_steps):
            gradient = system.gradient + tilt
            diagonal = self.order.diagonal_of(system)
            raised = (damping.share + LEAST_DAMPING) * diagonal + _LEAST_INFORMATION
            try:
                factor = self.order.factorise(system, raised)
            except NotPositiveError:
                damping.reject_step()
                if damping.is_exhausted:
                    return SolvedProblem(values, cost, None, False, n_linearisations)
                system, _ = self.system(values)
                continue
            step = -factor.solve(gradient)
            most = np.abs(step[scales]).max(initial=0.0)
            step *= min(1.0, _MOST_SCALED / max(most, 1e-12))
            slope = float(gradient @ step)
            expected = -0.5 * slope
            if expected < tolerance:
                values = self.move(values, step)
                return SolvedProblem(values, cost, factor, True, n_linearisations)
            taken, new_cost, there = None, cost, values
            for share in _SHARES:
                there = self.move(values, share * step)
                system, new_cost = self.system(there)
                n_linearisations += 1
                new_cost += float(tilt @ (total + share * step))
                if new_cost < cost - 1e-4 * share * expected:
                    taken = share
                    break
            if taken is None:
                damping.reject_step()
                if damping.is_exhausted:
                    return SolvedProblem(values, cost, factor, False, n_linearisations)
                system, _ = self.system(values)
                continue
            damping.accept_step((cost - new_cost) / max(taken * (2.0 - taken) * expected, 1e-12))
            total += taken * step
            values, cost = there, new_cost
        return SolvedProblem(values, cost, factor, False, n_linearisations)

    def factor_at(self, values: Variables, *, is_information: bool = False) -> FrontFactor:
        """Return the factor of the normal equations, or of the information, raised where nothing determines a variable.

        Raises:
            OfflineError: the values are beyond what numbers hold.
        """
        share = LEAST_DAMPING
        while share < 1.0:
            system, _ = self.system(values, is_information=is_information)
            diagonal = self.order.diagonal_of(system)
            try:
                return self.order.factorise(system, share * diagonal + _LEAST_INFORMATION)
            except NotPositiveError:
                share *= 10.0
        raise OfflineError("the drives determine no map: their readings contradict each other beyond any noise")

    def move(self, values: Variables, step: FloatArray) -> Variables:
        """Return the values after a step (n,)."""
        poses, points, calibration, _ = self.columns
        padded = np.append(step, 0.0)  # a column of -1 is the zero at the end
        by = padded[calibration]
        by[self.calibration.scaled_with_map] += by[self.map_scale]
        grown = by.copy()
        grown[0] = by[self.map_scale]  # of joint places
        moved = values.poses + padded[poses]
        moved[:, :2] *= np.exp(grown[self.distance_of_poses])[:, None]
        stretched = np.exp(grown[self.distance_of_points])[:, None] * (values.points + padded[points])
        return Variables(moved, stretched, values.calibration + by)

    def reckon(self, values: Variables, first: int, end: int) -> None:
        """Set poses first + 1 to end - 1, of one drive, by the motions from pose `first` on."""
        begin = int(np.searchsorted(self.motions.first, first))
        own = slice(begin, begin + end - 1 - first)
        c = values.calibration[self.motions.parameters[own]]
        turn = self.motions.turn[own] + (self.motions.by_turn[own] * c[:, 1:]).sum(axis=1)
        along = self.motions.along[own] + np.einsum("mik,mk->mi", self.motions.by_along[own], c[:, 1:])
        heading = values.poses[first, 2] + np.append(0.0, np.cumsum(turn))
        half = np.column_stack([np.zeros((len(turn), 2)), heading[:-1] + 0.5 * turn])
        moved = se2.apply(half, np.exp(c[:, :1]) * along)
        values.poses[first + 1 : end, :2] = values.poses[first, :2] + np.cumsum(moved, axis=0)
        values.poses[first + 1 : end, 2] = heading[1:]


def transform(values: Variables, T: FloatArray) -> Variables:
    """Return the values in another frame, moved by T (3,)."""
    poses = np.column_stack([se2.apply(T, values.poses[:, :2]), values.poses[:, 2] + T[2]])
    return values._replace(poses=poses, points=se2.apply(T, values.points))


def places_of(readings: ReadingArrays, values: Variables) -> FloatArray:
    """Return (M, 2) where each reading puts its point in map, by the poses and calibration."""
    c, own = values.calibration, readings.parameters
    late = c[own[:, 3]] - readings.applied_s
    poses = values.poses[readings.pose]
    heading = poses[:, 2] - late * readings.velocity[:, 2]
    turn = np.column_stack([np.zeros((len(late), 2)), heading])
    place = poses[:, :2] - late[:, None] * se2.apply(turn, readings.velocity[:, :2])
    base = np.column_stack([place, heading])
    value = readings.value + np.einsum("mij,mj->mi", readings.linear, c[own[:, 8:11]])
    polar = readings.polar > 0.5
    bearing = np.where(polar, value[:, 1], np.arctan2(value[:, 1], value[:, 0]))
    range_m = np.where(polar, value[:, 0], np.hypot(value[:, 0], value[:, 1])) - c[own[:, 4]]
    scale = np.exp(c[own[:, 5]] - c[own[:, 7]]) * np.maximum(np.cos(bearing), 0.2) ** c[own[:, 6]]
    rho = range_m / scale
    in_sensor = rho[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    mount = readings.mount + c[own[:, :3]]
    return np.asarray(se2.apply(base, se2.apply(mount, in_sensor)))


def _layout(drives: Sequence[Drive], *, by_pass: bool) -> Layout:
    first = np.concatenate([[0], np.cumsum([each.n_poses for each in drives])])
    own = [Own(d, tag) for d, drive in enumerate(drives) for tag in drive.segment.tags]
    seen: dict[TagKey, list[int]] = {}
    for i, each in enumerate(own):
        seen.setdefault(each.tag, []).append(i)
    joint = sorted(tag for tag, which in seen.items() if len(which) > 1)
    ties = [(i, len(own) + k) for k, tag in enumerate(joint) for i in seen[tag]]
    begins = np.cumsum([0, *(len(drive.segment.tags) for drive in drives)]).tolist()
    readings = [each + drive.segment.observations.tag for each, drive in zip(begins, drives, strict=False)]
    of_pass, points, n = [np.zeros(0, dtype=np.int64)], readings, len(own) + len(joint)
    if by_pass:
        points = []
        for drive, reading in zip(drives, readings, strict=True):
            _, at, which = np.unique(drive.passes, return_index=True, return_inverse=True)
            of_pass.append(reading[at])
            points.append(n + which)
            n += len(at)
    tie = np.array(ties, dtype=np.int64).reshape(-1, 2)
    return Layout(first, own, joint, tie, np.concatenate(of_pass), np.concatenate(points).astype(np.int64))


def _motions(drives: Sequence[Drive], calibration: CalibrationModel, layout: Layout) -> MotionArrays:
    tangents = [wheel_jacobian(each) for each in drives]
    width = max(each.shape[2] for each in tangents) + 1
    first, along, turn, by_along, by_turn, parameters = [], [], [], [], [], []
    for drive, tangent, begin in zip(drives, tangents, layout.first_pose, strict=False):
        odometry = drive.segment.odometry
        n, motion = len(odometry), odometry.motion
        # The change of the motion's coordinates, then of the chord in axes halfway through the turn.
        cos, sin = np.cos(0.5 * motion[:, 2]), np.sin(0.5 * motion[:, 2])
        half = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], axis=1)
        chord = np.einsum("mij,mj->mi", half, motion[:, :2])
        by_chord = half.swapaxes(1, 2) @ tangent[:, :2]
        by_chord = by_chord + 0.5 * np.stack([chord[:, 1], -chord[:, 0]], -1)[:, :, None] * tangent[:, 2:]
        pad = width - 1 - tangent.shape[2]
        first.append(begin + np.arange(n))
        along.append(chord)
        turn.append(motion[:, 2])
        by_along.append(np.pad(by_chord, ((0, 0), (0, 0), (0, pad))))
        by_turn.append(np.pad(tangent[:, 2], ((0, 0), (0, pad))))
        names = [calibration.index(each) for each in wheel_names(drive)]
        parameters.append(np.tile(np.pad(np.array(names), (0, pad)), (n, 1)))
    return MotionArrays(
        np.concatenate(first), np.ascontiguousarray(np.concatenate(along)), np.concatenate(turn).copy(),
        np.ascontiguousarray(np.concatenate(by_along)), np.ascontiguousarray(np.concatenate(by_turn)),
        np.ascontiguousarray(np.concatenate(parameters)), np.ones((sum(map(len, first)), 3)),
    )  # fmt: skip


def _readings(drives: Sequence[Drive], calibration: CalibrationModel, layout: Layout) -> ReadingArrays:
    kept: list[ReadingArrays] = []
    begin = 0
    for d, drive in enumerate(drives):
        segment, observations = drive.segment, drive.segment.observations
        robot, cameras = segment.run.robot, segment.run.robot.camera_names
        names = [
            [
                [calibration.index(each) for each in reading_names(robot, camera, parameter_of_scale(robot, tag).owner)]
                for tag in segment.tags
            ]
            for camera in cameras
        ]
        parameters = np.array(names, dtype=np.int64).reshape(len(cameras), -1, 12)[
            observations.camera, observations.tag
        ]
        parameters[~observations.in_camera, :3] = 0
        stretch = np.where(parameters[:, -1] == calibration.map_scale, 0, calibration.map_scale)
        parameters = np.column_stack([parameters, stretch])
        n = len(observations)
        kept.append(
            ReadingArrays(
                pose=layout.first_pose[d] + observations.keyframe,
                point=layout.reading[begin : begin + n],
                value=observations.value,
                polar=observations.polar.astype(np.float64),
                whitening=np.zeros((n, 2, 2)),
                mount=segment.T_base_sensor.reshape(-1, 3),
                velocity=drive.velocity[observations.keyframe],
                applied_s=np.full(n, drive.delay_s),
                linear=linear_of_readings(drive),
                parameters=parameters,
            )
        )
        begin += n
    return ReadingArrays(*(np.ascontiguousarray(np.concatenate(each)) for each in zip(*kept, strict=True)))


def _whitening(covariance: FloatArray) -> FloatArray:
    """Return lower triangular W (M, 2, 2) with W^T W = covariance^-1, the second row from both components."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    found = np.zeros_like(covariance)
    found[:, 0, 0] = 1.0 / np.sqrt(a)
    rest = 1.0 / np.sqrt(c - b * b / a)
    found[:, 1, 0], found[:, 1, 1] = -rest * b / a, rest
    return found
