"""Tag observations in metres, each with its covariance: what a segment is solved from.

An observation is a tag's place on the floor as (range, bearing) or (x, y), about the camera or about base.
"""

from dataclasses import dataclass, replace

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS, EDGE_SHIFT, NoiseParameters
from groundsbot.offline.measurements.covariance_components import CovarianceParts, concatenate


@dataclass(frozen=True)
class Observations:
    """M tag observations.

    Attributes:
        keyframe: (M,) index of the pose it was taken from.
        tag: (M,) index into the tags of the run.
        value: (M, 2) (range_m, bearing_rad) where polar, else (x_m, y_m); bearing positive to the left.
        covariance: (M, 2, 2) of the value.
        parts: what the covariance is made of.
        by_camera: (M, 2, 5) derivative of the value by CAMERA_PARAMETERS.
        polar: (M,)
        in_camera: (M,) about the camera's place and yaw, else about base.
        corners_px: (M, 4, 2) what the value was worked out from; NaN where somebody else did that.
        corner_bias_px: (M, 2) sigmas of what such corners err by alike in neighbouring observations, whatever noise
            they have: up and down, which is what the value errs by, and in all ways.
        corner_sigmas: (M,) how many times the noise's sigma such corners count with.
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

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.tag)

    @property
    def from_corners(self) -> BoolArray:
        """(M,) which of them came from corners that the log still has."""
        return np.asarray(np.isfinite(self.corners_px).all((-1, -2)))

    @property
    def corner_sigma_px(self) -> float:
        """The sigma of corners that the covariances of observations by corners alone were made with; 0 for none."""
        of_corners = self.from_corners
        if not of_corners.any():
            return 0.0
        made = np.trace(self.covariance - self.parts.rest, axis1=-2, axis2=-1)[of_corners].sum()
        unit = np.trace(self.parts.of(("sigma_corner_px",))[0], axis1=-2, axis2=-1)[of_corners].sum()
        return float(np.sqrt(max(made / unit, 0.0))) if unit > 0.0 else 0.0

    def where(self, mask: BoolArray | IntArray) -> "Observations":
        """Those of a mask, or of indices."""
        return Observations(
            self.keyframe[mask],
            self.tag[mask],
            self.value[mask],
            self.covariance[mask],
            self.parts.where(mask),
            self.by_camera[mask],
            self.polar[mask],
            self.in_camera[mask],
            self.corners_px[mask],
            self.corner_bias_px[mask],
            self.corner_sigmas[mask],
        )

    def with_edges_at(self, range_m: FloatArray) -> "Observations":
        """The same with what a shift of the tags' edges does taken at other ranges (M,) than those that were read.

        It grows with the square of the range. Taken at a range that errs by much, it goes along with the error, and a
        shift would be found that is none.
        """
        of_corners = self.from_corners & self.polar
        share = np.where(of_corners, range_m / np.where(of_corners, self.value[:, 0], 1.0), 1.0)
        by_camera = self.by_camera.copy()
        by_camera[:, 0, CAMERA_PARAMETERS.index(EDGE_SHIFT)] *= share**2
        return replace(self, by_camera=by_camera)

    def with_noise(self, noise: NoiseParameters) -> "Observations":
        """The same observations under other noise."""
        return replace(self, covariance=self.parts.under(noise))

    def inflate(self, sigmas: FloatArray, of_corners: FloatArray | None = None) -> "Observations":
        """The same observations with the sigmas of their whitened components (M, 2) so many times as large.

        Those of the corners (M,) grow by what is given for them, else like the larger of the two.
        """
        root = np.linalg.cholesky(self.covariance)
        turn = root @ (sigmas[..., None] * np.linalg.inv(root))
        back = turn.swapaxes(-1, -2)
        parts = replace(self.parts, unit=turn @ self.parts.unit @ back, rest=turn @ self.parts.rest @ back)
        return replace(
            self,
            covariance=turn @ self.covariance @ back,
            parts=parts,
            corner_sigmas=self.corner_sigmas * (sigmas.max(axis=-1) if of_corners is None else of_corners),
        )


def concatenate_observations(a: Observations, b: Observations) -> Observations:
    """Both, ordered by keyframe."""
    both = Observations(
        np.concatenate([a.keyframe, b.keyframe]),
        np.concatenate([a.tag, b.tag]),
        np.concatenate([a.value, b.value]),
        np.concatenate([a.covariance, b.covariance]),
        concatenate(a.parts, b.parts),
        np.concatenate([a.by_camera, b.by_camera]),
        np.concatenate([a.polar, b.polar]),
        np.concatenate([a.in_camera, b.in_camera]),
        np.concatenate([a.corners_px, b.corners_px]),
        np.concatenate([a.corner_bias_px, b.corner_bias_px]),
        np.concatenate([a.corner_sigmas, b.corner_sigmas]),
    )
    return both.where(np.argsort(both.keyframe, kind="stable"))


def no_observations() -> Observations:
    """None at all."""
    empty_int = np.zeros(0, dtype=np.int64)
    empty_bool = np.zeros(0, dtype=np.bool_)
    none = np.zeros((0, 2, 2))
    parts = CovarianceParts((), np.zeros((0, 0, 2, 2)), none)
    by_camera = np.zeros((0, 2, len(CAMERA_PARAMETERS)))
    corners_px, bias_px, sigmas = np.zeros((0, 4, 2)), np.zeros((0, 2)), np.zeros(0)
    return Observations(
        empty_int, empty_int, np.zeros((0, 2)), none, parts, by_camera, empty_bool, empty_bool, corners_px, bias_px,
        sigmas,
    )  # fmt: skip
