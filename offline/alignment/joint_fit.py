"""Joint least-squares fit of two local maps to some of the tags they share.

With xi_a, xi_b the errors of the maps and T the pose of frame b in frame a, the shared tags M impose f_a(xi_a) = T
f_b(xi_b). The minimum of xi_a' C_a^-1 xi_a + xi_b' C_b^-1 xi_b under this condition is the cost increase of solving
both runs together over the local maps (in squared sigmas). It is chi-square with 2 M - 3 degrees of freedom where the
tags are the same. It is found by Gauss-Newton on the condition (generalised least squares with the joint covariance S
of the differences), linearised anew at each step: the Gauss-Helmert model, as in Foerstner and Wrobel, "Photogrammetric
Computer Vision" (2016), section 4.8.

Calibration is a nuisance parameter of each local solve, so the covariances include its uncertainty, that of the scale
too. The two maps' calibrations are taken as independent. Where they are one robot's, or one batch of tags, their errors
are common and the true differences smaller than S: the test then loses power, but raises no false alarms.

By its covariance, two tags observed together a hundred times agree between runs to a tenth of a millimetre. It contains
noise only. A mount that pitches, residual lens distortion or a board that leans shift a tag by millimetres, by more for
more different views. So S also contains a sigma of 1 cm for each tag, small against any tag that was moved.
"""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from scipy import linalg
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.condensed_map import AnchorTree, rotate_quarter
from groundsbot.offline.alignment.tag_gate import FALSE_ALARM, gate_ratio, log_likelihood_ratio
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M
from groundsbot.offline.sam import Budget

_STEPS: Final = 8
_CONVERGED_SIGMAS: Final = 1e-3
# Work in units of the budget: overhead of Python for each fit and for each linearisation.
_A_CALL: Final = 5e6
# Times the cube of the number of tags: (2 n)^3 / 2 to factorise and substitute; 2 (2 n) (5 n) (7 n) to propagate both
# maps' covariances, in products of large matrices, which are three times as fast.
_BY_FITTED: Final = 4.0
_BY_TAGS: Final = 50.0


@dataclass(frozen=True)
class FitState:
    """Linearisation point: T_a_b and the errors of both maps."""

    T_a_b: FloatArray  # (3,)
    xi_a: FloatArray  # (5 n,)
    xi_b: FloatArray


@dataclass(frozen=True)
class LinearisedFit:
    """Differences between the positions of n shared tags in two local maps, linearised at `at`.

    f_a - T_a_b f_b = difference + by_transform dT + noise, with positions f_a in map a and f_b in map b. The rows are x
    and y of the first tag, then of the next, along the axes of map a.

    Attributes:
        at: linearisation point.
        centre: (2,) point in map a about which `dT` rotates map b, in m.
        difference: (2 n,) f_a - T_a_b f_b for maps without errors, in m.
        covariance: (2 n, 2 n) covariance of the noise, in m^2.
        by_transform: (2 n, 3) derivative with respect to dT, a small shift (m) and rotation (rad) of map b.
        by_a: (2 n, 5 n) derivative with respect to `FitState.xi_a`.
        by_b: (2 n, 5 n) derivative with respect to `FitState.xi_b`.
        budget: computing budget, reduced by each fit to some of these tags.
    """

    at: FitState
    centre: FloatArray
    difference: FloatArray
    covariance: FloatArray
    by_transform: FloatArray
    by_a: FloatArray
    by_b: FloatArray
    budget: Budget = field(default_factory=Budget)


class JointFit:
    """Anchor trees of two maps over the same n tags in the same order."""

    def __init__(
        self,
        a: AnchorTree,
        b: AnchorTree,
        unmodelled_sigma_m: float = UNMODELLED_SIGMA_M,
        budget: Budget | None = None,
    ) -> None:
        """Store the trees.

        Args:
            a: anchor tree of map a.
            b: anchor tree of map b, over the same tags in the same order.
            unmodelled_sigma_m: standard deviation added to each coordinate of each tag, see above.
            budget: computing budget of the alignment; None: unlimited.
        """
        self.a, self.b = a, b
        self.n = len(a.step)
        self.unmodelled_m2 = unmodelled_sigma_m**2
        self._budget = budget or Budget()

    def _charge_linearisation(self) -> None:
        self._budget.charge(_A_CALL + _BY_TAGS * self.n**3)

    @cached_property
    def _at_zero_errors(
        self,
    ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]:
        self._charge_linearisation()
        none = np.zeros(5 * self.n)
        return _places_with_covariance(self.a, none), _places_with_covariance(self.b, none)

    @property
    def places_a(self) -> FloatArray:
        """Tag positions (n, 2) in map a; `places_b` in frame b."""
        return self._at_zero_errors[0][0]

    @property
    def places_b(self) -> FloatArray:
        """Tag positions (n, 2) in map b."""
        return self._at_zero_errors[1][0]

    @property
    def covariance_a(self) -> FloatArray:
        """Covariance (2 n, 2 n) of map a's tags relative to its root, to first order; `covariance_b` likewise."""
        return self._at_zero_errors[0][2]

    @property
    def covariance_b(self) -> FloatArray:
        """Covariance (2 n, 2 n) of map b's tags."""
        return self._at_zero_errors[1][2]

    def point_without_errors(self, T_a_b: FloatArray) -> FitState:
        """Return the linearisation point of both maps without errors."""
        return FitState(T_a_b, np.zeros(5 * self.n), np.zeros(5 * self.n))

    def linearise(self, bend: FitState) -> LinearisedFit:
        """Return the differences around a linearisation point."""
        bent = bool(bend.xi_a.any() or bend.xi_b.any())
        if bent:
            self._charge_linearisation()
        (f_a, J_a, S_a), (f_b, J_b, S_b) = (
            (_places_with_covariance(self.a, bend.xi_a), _places_with_covariance(self.b, bend.xi_b))
            if bent
            else self._at_zero_errors
        )
        cos, sin = np.cos(bend.T_a_b[2]), np.sin(bend.T_a_b[2])
        R = np.array([[cos, -sin], [sin, cos]])
        by_b = -(R @ J_b.reshape(self.n, 2, -1)).reshape(J_b.shape)
        turned = (R @ S_b.reshape(self.n, 2, -1)).reshape(S_b.shape)
        turned = np.einsum("iaj,ba->ibj", turned.T.reshape(self.n, 2, -1), R).reshape(S_b.shape)
        in_a = se2.apply(bend.T_a_b, f_b)
        centre = in_a.mean(axis=0)
        by_transform = np.zeros((self.n, 2, 3))
        by_transform[:, :, :2] = -np.eye(2)
        by_transform[:, :, 2] = -rotate_quarter(in_a - centre)
        apart = (f_a - in_a).reshape(-1) - J_a @ bend.xi_a - by_b @ bend.xi_b
        covariance = S_a + turned
        covariance[np.diag_indices(2 * self.n)] += self.unmodelled_m2
        return LinearisedFit(bend, centre, apart, covariance, by_transform.reshape(-1, 3), J_a, by_b, self._budget)

    def retract(self, linear: LinearisedFit, held: "SubsetFit") -> FitState:
        """Return the linearisation point after a step: the errors with which the fitted tags agree."""
        pull = np.zeros(2 * self.n)
        pull[held.rows] = held.weighted_residual
        return FitState(
            held.T_a_b,
            -self.a.covariance @ (linear.by_a.T @ pull),
            -self.b.covariance @ (linear.by_b.T @ pull),
        )

    def solve(self, bend: FitState, members: BoolArray) -> tuple[LinearisedFit, "SubsetFit"]:
        """Iterate the fit of these tags (n,) to convergence, from a linearisation point nearby."""
        linear = self.linearise(bend)
        held = fit_members(linear, members)
        for _ in range(_STEPS):
            linear = self.linearise(self.retract(linear, held))
            before, held = held, fit_members(linear, members)
            left = float(held.motion @ held.information @ held.motion)
            if left < _CONVERGED_SIGMAS**2 and abs(before.cost_increase - held.cost_increase) < _CONVERGED_SIGMAS * (
                1.0 + held.cost_increase
            ):
                break
        return linear, held


@dataclass(frozen=True)
class SubsetFit:
    """Least-squares fit of some tags of a `LinearisedFit`.

    Attributes:
        rows: (2 m,) of these tags.
        root: (2 m, 2 m) lower Cholesky factor of the covariance.
        motion: (3,) estimated motion of map b.
        information: (3, 3) of it.
        weighted_residual: (2 m,) inverse covariance times residual.
        cost_increase: sum of squared sigmas of m tags, chi-square with 2 m - 3 degrees of freedom.
        log_determinant: log-determinant of their covariance.
    """

    linear: LinearisedFit
    rows: IntArray
    whitened: FloatArray  # (2 m, 3) by_transform
    motion: FloatArray
    information: FloatArray
    weighted_residual: FloatArray
    whitened_residual: FloatArray  # (2 m,) whitened residual

    @property
    def T_a_b(self) -> FloatArray:
        """Pose (3,) of frame b in frame a after the motion."""
        dx, dy, turn = self.motion
        centre = self.linear.centre
        about = centre - se2.apply([0.0, 0.0, turn], centre)
        return se2.compose([about[0] + dx, about[1] + dy, turn], self.linear.at.T_a_b)

    @property
    def cost_increase(self) -> float:
        """Cost in squared sigmas."""
        return float(self.whitened_residual @ self.whitened_residual)

    @property
    def is_consistent(self) -> bool:
        """Whether the cost is below the chi-square gate."""
        return self.cost_increase <= _cost_increase_bound(len(self.rows) - 3)

    @cached_property
    def root(self) -> FloatArray:
        """Computed again if asked for after `without_root`."""
        return _root(self.linear, self.rows)

    def free_root(self) -> None:
        """Free the Cholesky factor, which may be most of the memory; its log determinant stays cached."""
        _ = self.log_determinant
        vars(self).pop("root", None)

    @cached_property
    def log_determinant(self) -> float:
        """Log determinant of the covariance of the differences."""
        return 2.0 * float(np.log(np.diag(self.root)).sum())

    def predict_others(self) -> tuple[FloatArray, FloatArray]:
        """Return residuals (n, 2) of predicted tags and covariances (n, 2, 2); undefined for the fitted tags."""
        linear = self.linear
        n = len(linear.difference) // 2
        coupled = linalg.solve_triangular(self.root, linear.covariance[self.rows], lower=True, check_finite=False)
        off = linear.difference + linear.by_transform @ self.motion - coupled.T @ self.whitened_residual
        lever = (linear.by_transform - coupled.T @ self.whitened).reshape(n, 2, 3)
        each = coupled.reshape(-1, n, 2)
        own = linear.covariance.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n), :]
        spread = own - np.einsum("ria,rib->iab", each, each)
        spread += lever @ np.linalg.inv(self.information) @ lever.transpose(0, 2, 1)
        return off.reshape(n, 2), spread

    def leave_one_out(self) -> tuple[FloatArray, FloatArray]:
        """Return leave-one-out residuals of the fitted tags: at least three.

        With P the inverse covariance projected orthogonally to the motion, P_ii^-1 (P w)_i is the residual of tag i
        under the prediction from the others, and P_ii^-1 its covariance (Baarda's data snooping).

        Returns:
            (m, 2) differences, and (m, 2, 2) their covariances.
        """
        m = len(self.rows) // 2
        inverse_root = linalg.solve_triangular(self.root, np.eye(2 * m), lower=True, check_finite=False)
        lever = (inverse_root.T @ self.whitened).reshape(m, 2, 3)
        each = inverse_root.reshape(2 * m, m, 2)
        P = np.einsum("rma,rmb->mab", each, each)
        P -= lever @ np.linalg.inv(self.information) @ lever.transpose(0, 2, 1)
        covariance = np.linalg.inv(P)
        return (covariance @ self.weighted_residual.reshape(m, 2, 1))[..., 0], covariance

    def gate_ratios(self) -> FloatArray:
        """Return (m,) leave-one-out gate ratios of the fitted tags, see `gate_ratio`; at least three tags."""
        return gate_ratio(*self.leave_one_out())

    def log_likelihood_ratio(self) -> FloatArray:
        """Return (m,) leave-one-out log likelihood ratios of fitting over wrong; at least three tags."""
        return log_likelihood_ratio(*self.leave_one_out())

    def motion_covariance(self) -> FloatArray:
        """Return the covariance (3, 3) of the motion."""
        return np.asarray(np.linalg.inv(self.information), dtype=np.float64)


@lru_cache
def _cost_increase_bound(freedom: int) -> float:
    return float(chdtri(freedom, FALSE_ALARM))


def fit_members(linear: LinearisedFit, members: BoolArray) -> SubsetFit:
    """Fit some tags (n,), at least two, by least squares."""
    rows = (2 * np.flatnonzero(members)[:, None] + np.arange(2)).reshape(-1)
    linear.budget.charge(_A_CALL + _BY_FITTED * (len(rows) // 2) ** 3)
    root = _root(linear, rows)
    right = np.column_stack([linear.by_transform[rows], linear.difference[rows]])
    right = linalg.solve_triangular(root, right, lower=True, check_finite=False)
    whitened, apart = right[:, :3], right[:, 3]
    information = whitened.T @ whitened
    motion = -np.linalg.solve(information, whitened.T @ apart)
    left = apart + whitened @ motion
    pull = linalg.solve_triangular(root, left, lower=True, trans=1, check_finite=False)
    held = SubsetFit(linear, rows, whitened, motion, information, pull, left)
    vars(held)["root"] = root  # fills the cached property
    return held


def _root(linear: LinearisedFit, rows: IntArray) -> FloatArray:
    S = linear.covariance[np.ix_(rows, rows)]
    # Noise-free observations leave rounding only; this is far below any true sigma.
    S[np.diag_indices(len(rows))] += 1e-12 * float(np.trace(S)) / len(rows) + 1e-18
    return np.asarray(linalg.cholesky(S, lower=True, check_finite=False), dtype=np.float64)


def _places_with_covariance(tree: AnchorTree, xi: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    places, jacobian = tree.jacobian(xi)
    return places, jacobian, jacobian @ tree.covariance @ jacobian.T
