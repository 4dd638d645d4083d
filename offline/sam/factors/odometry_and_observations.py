"""Residuals and Jacobians of odometry, tag observations and calibration priors.

Each class holds all M factors of a kind, and returns whitened residuals (M, n) and Jacobian blocks: pairs of columns
(M, k) of the tangent vector and derivatives (M, n, k). A column of -1 marks a fixed variable.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Final, NamedTuple

import numpy as np
from scipy import sparse

from groundsbot.calib.foundation import BoolArray, FloatArray, IndexArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.linearisation.kernels import ObservationArrays, Values
from groundsbot.offline.sam.linearisation.observations import FADED_BELOW, N_OBSERVATION, linearise_observations

_FEW_ROWS: Final = 3


@dataclass(frozen=True)
class State:
    """The values of all variables.

    Attributes:
        poses: (P, 3) T_map_base (x, y, theta in m, m, rad) of all segments, concatenated.
        tags: (T, 2) positions in map, in m.
        calibration: (C,) corrections to nominal values.
    """

    poses: FloatArray
    tags: FloatArray
    calibration: FloatArray


class Linearised(NamedTuple):
    """The whitened residuals (M, n) and Jacobian blocks of (columns (M, k), derivatives (M, n, k))."""

    residual: FloatArray
    blocks: tuple[tuple[IntArray, FloatArray], ...]


@dataclass(frozen=True)
class Columns:
    """The columns of each variable in the tangent vector; -1 where fixed.

    Attributes:
        poses: (P, 3) columns of right perturbations.
        tags: (T, 2) columns of additive perturbations.
        calibration: (C,) columns of additive perturbations.
        n: length of the tangent vector.
    """

    poses: IntArray
    tags: IntArray
    calibration: IntArray
    n: int

    def check(self, state: State) -> None:
        """Check that the state has as many variables, since compiled loops do not check bounds.

        Raises:
            ValueError: the sizes differ.
        """
        wanted = len(self.poses), len(self.tags), len(self.calibration)
        if (len(state.poses), len(state.tags), len(state.calibration)) != wanted:
            raise ValueError("the state has another number of poses, tags or calibration parameters than the problem")


@dataclass(frozen=True)
class OdometryFactors:
    """Odometry between consecutive keyframes: r = W S(c) log(M(c)^-1 o T_i^-1 o T_j).

    M(c) = motion o exp(jacobian c), where c are the wheel and gyro parameters. S divides lengths by (1 + wheel_scale),
    so that the residual is in metres as counted by the wheels. With residuals in true metres, a smaller scale of map,
    wheels and tags would lower all residuals, and thousands of them together would dominate the scale prior.

    Attributes:
        first: (M,) index of T_i; T_j is the next pose.
        motion: (M, 3) motion of base by nominal calibration.
        whitening: (M, 3, 3) W such that W^T W is the information in the motion's right tangent space.
        jacobian: (M, 3, P) derivative of the motion with respect to the parameters of wheels and gyro, in the right
            tangent space.
        parameters: (M, P) indices into the calibration, wheel_scale first.
    """

    first: IntArray
    motion: FloatArray
    whitening: FloatArray
    jacobian: FloatArray
    parameters: IntArray | IndexArray

    def residual(self, state: State) -> FloatArray:
        """Return whitened residuals (M, 3)."""
        error, _, _ = self._error(state)
        return _times(self.scaled_whitening(state), error)

    def linearise(self, state: State, columns: Columns) -> Linearised:
        """Return residuals (M, 3) and blocks for both poses and the wheel parameters."""
        error, moved, twist = self._error(state)
        outer = self.scaled_whitening(state)
        by_second = outer @ se2.right_jacobian_inverse(error)
        by_first = -by_second @ se2.adjoint(se2.inverse(moved))
        # log(exp(-(t + dt)) o G) with t = jacobian c is a left perturbation.
        by_twist = -outer @ se2.right_jacobian_inverse(-error) @ se2.right_jacobian(twist)
        by_parameters = by_twist @ self.jacobian
        scale = 1.0 + state.calibration[self.parameters[:, 0]]
        by_parameters[..., 0] -= _times(outer[..., :2], error[:, :2] / scale[:, None])
        return Linearised(
            _times(outer, error),
            (
                (columns.poses[self.first], by_first),
                (columns.poses[self.first + 1], by_second),
                (columns.calibration[self.parameters], by_parameters),
            ),
        )

    def part(self, which: BoolArray | IntArray | slice) -> "OdometryFactors":
        """Return some of the factors."""
        return OdometryFactors(**{each.name: getattr(self, each.name)[which] for each in fields(self)})

    def predict(self, state: State) -> FloatArray:
        """Return the motions M(c) (M, 3) by the corrected calibration."""
        return se2.compose(self.motion, se2.exp(self._twist(state)))

    def scaled_whitening(self, state: State) -> FloatArray:
        """Return W S(c) (M, 3, 3)."""
        scaled = self.whitening.copy()
        scaled[..., :2] /= (1.0 + state.calibration[self.parameters[:, 0]])[:, None, None]
        return scaled

    def _error(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        moved = se2.between(state.poses[self.first], state.poses[self.first + 1])
        return se2.log(se2.between(self.predict(state), moved)), moved, self._twist(state)

    def _twist(self, state: State) -> FloatArray:
        return _times(self.jacobian, state.calibration[self.parameters])


@dataclass(frozen=True)
class ObservationFactors:
    """Positions of tags observed from poses, as (range, bearing) or (x, y) in the frame of a sensor on the base.

    With l the tag in map, l_base = R^T (l - t) and l_sensor = R(yaw)^T (l_base - mount) / (1 + tag_scale). The residual
    compares l_sensor or its polar coordinates with the value; the bearing fades out where the tag is predicted far
    nearer than observed (`FADED_BELOW`). Other camera parameters shift the value, to first order.

    Attributes:
        pose, tag: (M,) indices of pose and tag.
        value: (M, 2) observed value, in m or in m and rad.
        polar: (M,) whether the value is (range, bearing).
        whitening: (M, 2, 2) W such that W^T W is the information of the value.
        mount: (M, 3) nominal x_m, y_m, yaw_rad of the sensor in base.
        mount_parameters, scale_parameter: (M, 3) and (M,) indices into the calibration.
        by_camera: (M, 2, 5) derivative of the value with respect to CAMERA_PARAMETERS.
        camera_parameters: (M, 5) indices of CAMERA_PARAMETERS in the calibration.
        turning_rad_s: (M,) turning rate of base, on which the change of `by_camera` with the pose depends.
    """

    pose: IntArray
    tag: IntArray
    value: FloatArray
    polar: BoolArray
    whitening: FloatArray
    mount: FloatArray
    mount_parameters: IntArray | IndexArray
    scale_parameter: IntArray | IndexArray
    by_camera: FloatArray
    camera_parameters: IntArray | IndexArray
    turning_rad_s: FloatArray

    def residual(self, state: State) -> FloatArray:
        """Return whitened residuals (M, 2), predicted minus observed."""
        return _times(self.whitening, self._difference(self._in_sensor(state), state))

    def linearise(self, state: State, columns: Columns) -> Linearised:
        """Return residuals (M, 2) and blocks for pose, tag, mount, tag scale and camera parameters."""
        n = len(self.pose)
        residual, jacobian = np.empty((n, 2)), np.empty((n, 2, N_OBSERVATION))
        linearise_observations(self.arrays, Values(state.poses, state.tags, state.calibration), residual, jacobian)
        by_pose, by_tag, by_mount, by_scale, by_camera = np.split(jacobian, [3, 5, 8, 9], axis=-1)
        return Linearised(
            residual,
            (
                (columns.poses[self.pose], by_pose),
                (columns.tags[self.tag], by_tag),
                (columns.calibration[self.mount_parameters], by_mount),
                (columns.calibration[self.scale_parameter][:, None], by_scale),
                (columns.calibration[self.camera_parameters], by_camera),
            ),
        )

    @property
    def arrays(self) -> ObservationArrays:
        """The same factors for compiled functions; these have no slots and tag segments yet."""
        own = [self.mount_parameters, self.scale_parameter, self.camera_parameters]
        parameters = np.column_stack(own).astype(np.int32, copy=False)
        return ObservationArrays(
            pose=self.pose,
            tag=self.tag,
            value=np.ascontiguousarray(self.value),
            polar=self.polar,
            whitening=np.ascontiguousarray(self.whitening),
            mount=np.ascontiguousarray(self.mount),
            by_camera=np.ascontiguousarray(self.by_camera),
            parameters=parameters,
            slots=np.full_like(parameters, -1),
            tag_segment=np.full_like(self.tag, -1),
        )

    def with_other_tags(self, observation: int, tags: IntArray) -> "ObservationFactors":
        """Return K copies of one observation, each assigned to one of the tags (K,)."""
        return replace(self.part(np.full(len(tags), observation)), tag=tags)

    def part(self, which: BoolArray | IntArray | slice) -> "ObservationFactors":
        """Return some of the factors."""
        return ObservationFactors(**{each.name: getattr(self, each.name)[which] for each in fields(self)})

    def ranges_m(self, state: State) -> FloatArray:
        """Return the predicted ranges (M,) from sensor to tag, in m for tags of nominal size."""
        in_sensor = self._in_sensor(state)
        return np.asarray(np.hypot(in_sensor[:, 0], in_sensor[:, 1]))

    def places_in_map(self, state: State) -> FloatArray:
        """Return the position in map (M, 2) of each observation's tag, by the poses and calibration of a state."""
        value = self._correct(state)
        first, second = value.T
        in_sensor = np.where(
            self.polar[:, None], np.stack([first * np.cos(second), first * np.sin(second)], axis=-1), value
        )
        scale = 1.0 + state.calibration[self.scale_parameter]
        mount = self.mount + state.calibration[self.mount_parameters]
        return se2.apply(se2.compose(state.poses[self.pose], mount), in_sensor * scale[:, None])

    def _in_sensor(self, state: State) -> FloatArray:
        """Return (M, 2) places of the tags in the sensor frame, in lengths of their nominal scale."""
        mount = self.mount + state.calibration[self.mount_parameters]
        in_base = se2.apply(se2.inverse(state.poses[self.pose]), state.tags[self.tag])
        scale = 1.0 + state.calibration[self.scale_parameter]
        return np.asarray(se2.apply(se2.inverse(mount), in_base) / scale[:, None])

    def _correct(self, state: State) -> FloatArray:
        """Return the observed values (M, 2), corrected by the camera parameters."""
        return self.value + _times(self.by_camera, state.calibration[self.camera_parameters])

    def _difference(self, in_sensor: FloatArray, state: State) -> FloatArray:
        x, y = in_sensor[:, 0], in_sensor[:, 1]
        first, second = self._correct(state).T
        range_m = np.hypot(x, y)
        part = np.minimum(range_m / np.maximum(FADED_BELOW * self.value[:, 0], 1e-9), 1.0) ** 2
        turned = part * (2.0 - part) * se2.wrap_angle(np.arctan2(y, x) - second)
        return np.stack([np.where(self.polar, range_m, x) - first, np.where(self.polar, turned, y - second)], axis=-1)


@dataclass(frozen=True)
class CalibrationPrior:
    """Gaussian priors on the corrections c (C,) to the calibration of robot.yaml: r = c / sigma, and a joint factor.

    Attributes:
        sigma: (C,) sigmas of robot.yaml; a parameter with sigma 0 is fixed.
        rows: (R, C) Jacobian of the joint factor r = rows c + values; zero in fixed columns.
        values: (R,) constants of the joint factor.
    """

    sigma: FloatArray
    rows: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    values: FloatArray = field(default_factory=lambda: np.zeros(0))

    def joint_residual(self, state: State) -> FloatArray:
        """Return whitened residuals (R,) of the joint factor."""
        return np.asarray(self.rows @ state.calibration + self.values) if len(self.rows) else self.values

    def residual(self, state: State) -> FloatArray:
        """Return whitened residuals (C, 1) of the single parameters."""
        return (state.calibration / np.where(self.sigma > 0.0, self.sigma, 1.0))[:, None]

    def linearise(self, state: State, columns: Columns) -> Linearised:
        """Return residuals (C, 1) and one block."""
        weight = 1.0 / np.where(self.sigma > 0.0, self.sigma, 1.0)
        return Linearised(self.residual(state), ((columns.calibration[:, None], weight[:, None, None]),))


def stack(kinds: tuple[Linearised, ...], n_columns: int) -> tuple[sparse.csr_array, FloatArray]:
    """Return one sparse Jacobian (m, n), with unsorted columns within rows, and its residuals (m,)."""
    values, columns, counts, residuals = [], [], [np.zeros(1, dtype=np.int64)], []
    for kind in kinds:
        n = kind.residual.shape[1]
        own = np.concatenate([each for each, _ in kind.blocks], axis=1)
        free = np.repeat(own >= 0, n, axis=0)
        values.append(np.concatenate([each for _, each in kind.blocks], axis=2).reshape(free.shape)[free])
        columns.append(np.repeat(own, n, axis=0)[free])
        counts.append(free.sum(axis=1))
        residuals.append(kind.residual.reshape(-1))
    ends = np.cumsum(np.concatenate(counts))
    entries = (np.concatenate(values), np.concatenate(columns), ends)
    return sparse.csr_array(entries, shape=(len(ends) - 1, n_columns)), np.concatenate(residuals)


def whitening(covariance: FloatArray) -> FloatArray:
    """Return W (..., n, n) with W^T W = covariance^-1."""
    root = np.linalg.cholesky(covariance)
    n = root.shape[-1]
    if n > _FEW_ROWS:
        return np.linalg.inv(root)
    inverse = np.zeros_like(root)  # by forward substitution, ten times faster than `inv` for many small matrices
    for i in range(n):
        inverse[..., i, i] = 1.0 / root[..., i, i]
        for j in range(i):
            taken = (root[..., i, j:i] * inverse[..., j:i, j]).sum(axis=-1)
            inverse[..., i, j] = -taken * inverse[..., i, i]
    return inverse


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the products (M, n) of matrices (M, n, k) and vectors (M, k)."""
    products: FloatArray = np.einsum("mij,mj->mi", matrices, vectors)
    return products
