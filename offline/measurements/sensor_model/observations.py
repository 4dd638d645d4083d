"""Tag observations in metres, each with its covariance.

An observation is a tag's position on the floor as (range, bearing) or (x, y), in the camera's planar frame or in base.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS, EDGE_SHIFT, NoiseParameters
from groundsbot.offline.measurements.covariance_components import CovarianceParts, concatenate, propagate

# A nearer observation is a false detection, and its covariance would make the normal equations ill-conditioned.
MIN_RANGE_M: Final = 0.1


@dataclass(frozen=True)
class Observations:
    """M tag observations.

    Attributes:
        keyframe: (M,) index of the keyframe it was taken from.
        tag: (M,) index into the tags of the segment.
        value: (M, 2) (range_m, bearing_rad) where polar, else (x_m, y_m); bearing positive to the left.
        covariance: (M, 2, 2) of the value.
        parts: the components of the covariance.
        by_camera: (M, 2, 5) derivative of the value with respect to CAMERA_PARAMETERS.
        polar: (M,) whether the value is (range, bearing).
        in_camera: (M,) whether the value is in the camera's planar frame (position and yaw of the mount), not in base.
        corners_px: (M, 4, 2) raw pixels that the value was computed from; NaN where it was imported.
        corner_bias_px: (M, 2) sigmas of the corners' bias that neighbouring observations have in common, in addition to
            their noise: vertical, which is what affects the value, and in any direction.
        corner_sigmas: (M,) factor on the corners' sigma in bundle adjustment.
        face: (M, 4) `TagMeasurements.face` and the height (m) of the tag's centre above the camera; NaN where the value
            was imported or the tag is not upright.
        turning_rad_s: (M,) turning rate of base.
        heading_jitter_rad: (M,) sigma of an error of base's heading that is one for all observations of a keyframe, and
            independent from keyframe to keyframe; the covariance contains it. Zero without a gyro.
        camera: (M,) index of the camera in `Robot.camera_names`.
    """

    keyframe: IntArray
    tag: IntArray
    value: FloatArray
    covariance: FloatArray
    parts: CovarianceParts
    by_camera: FloatArray
    polar: BoolArray
    in_camera: BoolArray
    corners_px: FloatArray
    corner_bias_px: FloatArray
    corner_sigmas: FloatArray
    face: FloatArray
    turning_rad_s: FloatArray
    heading_jitter_rad: FloatArray
    camera: IntArray

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.tag)

    @property
    def from_corners(self) -> BoolArray:
        """(M,) which of them were computed from corners of the log."""
        return np.asarray(np.isfinite(self.corners_px).all((-1, -2)))

    @property
    def corner_sigma_px(self) -> float:
        """The corners' sigma that the covariances contain; 0 where no observation is from corners."""
        from_corners = self.from_corners
        if not from_corners.any():
            return 0.0
        total = np.trace(self.covariance - self.parts.rest, axis1=-2, axis2=-1)[from_corners].sum()
        unit = np.trace(self.parts.of(("sigma_corner_px",))[0], axis1=-2, axis2=-1)[from_corners].sum()
        return float(np.sqrt(max(total / unit, 0.0))) if unit > 0.0 else 0.0

    def where(self, mask: BoolArray | IntArray) -> "Observations":
        """Return the observations selected by a mask or by indices."""
        return Observations(parts=self.parts.where(mask), **{name: array[mask] for name, array in self._arrays()})

    def _arrays(self) -> Iterator[tuple[str, Any]]:
        """Yield the attributes that are arrays, by name."""
        return ((each.name, getattr(self, each.name)) for each in fields(self) if each.name != "parts")

    def with_edges_at(self, range_m: FloatArray) -> "Observations":
        """Return the observations with the derivative with respect to the edge shift evaluated at other ranges (M,).

        The derivative grows with the square of the range. Evaluated at the observed range it is correlated with the
        error of the range, which biases the estimate of the edge shift.
        """
        from_corners = self.from_corners & self.polar
        ratio = np.where(from_corners, range_m / np.where(from_corners, self.value[:, 0], 1.0), 1.0)
        by_camera = self.by_camera.copy()
        by_camera[:, 0, CAMERA_PARAMETERS.index(EDGE_SHIFT)] *= ratio**2
        return replace(self, by_camera=by_camera)

    def without_corners(self) -> "Observations":
        """Return the observations with covariances that depend on no noise parameter, as if they were imported.

        What is unknown of them is one value for all, which takes no memory.
        """
        n = len(self)
        return replace(
            self,
            parts=CovarianceParts.constant(self.covariance),
            corners_px=np.broadcast_to(np.nan, (n, 4, 2)),
            corner_bias_px=np.broadcast_to(0.0, (n, 2)),
            corner_sigmas=np.broadcast_to(1.0, n),
            face=np.broadcast_to(np.nan, (n, 4)),
        )

    def with_noise(self, noise: NoiseParameters) -> "Observations":
        """Return the observations with covariances for other noise parameters."""
        return replace(self, covariance=self.parts.under(noise))

    @property
    def jitter_root(self) -> FloatArray:
        """(M, 2) the change of each value for a heading off by one sigma of `heading_jitter_rad`.

        The distance of the sensor from base's centre is neglected.
        """
        x, y = self.value.T
        by_heading = np.where(self.polar[:, None], [0.0, -1.0], np.stack([y, -x], axis=-1))
        return np.asarray(self.heading_jitter_rad[:, None] * by_heading)

    def with_heading_jitter(self, sigma_rad: FloatArray) -> "Observations":
        """Return observations without jitter of the heading with one of these sigmas (M,)."""
        found = replace(self, heading_jitter_rad=sigma_rad)
        added = found.jitter_root[:, :, None] * found.jitter_root[:, None, :]
        parts = replace(self.parts, rest=self.parts.rest + added)
        return replace(found, covariance=self.covariance + added, parts=parts)

    def inflate(self, sigmas: FloatArray, of_corners: FloatArray | None = None) -> "Observations":
        """Return the observations with the sigmas of their whitened components multiplied.

        Args:
            sigmas: (M, 2) factors.
            of_corners: (M,) factors on the sigmas of the corners; the larger of the two `sigmas` where None.
        """
        root = np.linalg.cholesky(self.covariance)
        jacobian = root @ (sigmas[..., None] * np.linalg.inv(root))
        return replace(
            self,
            covariance=propagate(jacobian, self.covariance),
            parts=self.parts.propagate(jacobian),
            corner_sigmas=self.corner_sigmas * (sigmas.max(axis=-1) if of_corners is None else of_corners),
        )


def concatenate_observations(a: Observations, b: Observations) -> Observations:
    """Return both in one, ordered by keyframe."""
    arrays = {name: np.concatenate([array, getattr(b, name)]) for name, array in a._arrays()}
    both = Observations(parts=concatenate(a.parts, b.parts), **arrays)
    return both.where(np.argsort(both.keyframe, kind="stable"))


def no_observations() -> Observations:
    """Return an empty set of observations."""
    empty_int = np.zeros(0, dtype=np.int64)
    empty_bool = np.zeros(0, dtype=np.bool_)
    none = np.zeros((0, 2, 2))
    parts = CovarianceParts((), np.zeros((0, 0, 2, 2)), none)
    by_camera = np.zeros((0, 2, len(CAMERA_PARAMETERS)))
    corners_px, bias_px, sigmas = np.zeros((0, 4, 2)), np.zeros((0, 2)), np.zeros(0)
    face = np.zeros((0, 4))
    return Observations(
        empty_int, empty_int, np.zeros((0, 2)), none, parts, by_camera, empty_bool, empty_bool, corners_px, bias_px,
        sigmas, face, np.zeros(0), np.zeros(0), empty_int,
    )  # fmt: skip


def tag_rates(in_base_m: FloatArray, twist: FloatArray) -> FloatArray:
    """Return (M, 2) the velocities, in m/s, of stationary tags (M, 2) in the moving frame of base."""
    forward, left, turning = twist.T
    return np.stack([turning * in_base_m[:, 1] - forward, -turning * in_base_m[:, 0] - left], axis=-1)


def value_rates(in_sensor_m: FloatArray, polar: BoolArray, moved: FloatArray) -> FloatArray:
    """Return (M, 2) the change of observations where tags at (M, 2) move by (M, 2) in the sensor's axes."""
    x, y = in_sensor_m.T
    range_m = np.maximum(np.hypot(x, y), 1e-6)
    along, across = (x * moved[:, 0] + y * moved[:, 1]) / range_m, (x * moved[:, 1] - y * moved[:, 0]) / range_m
    return np.where(polar[:, None], np.stack([along, across / range_m], axis=-1), moved)
