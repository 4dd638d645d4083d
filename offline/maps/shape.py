"""Covariances of a component's tags relative to each other, without the uncertainty of the frame.

The joint covariance of the tags is transformed to the datum of the tags themselves (S-transformation: Baarda 1973,
"S-transformations and criterion matrices"). With G (2T, 3) the Jacobian with respect to a small shift and rotation of
all tags, S = I - G (G'G)^-1 G' projects onto the shape, whose covariance is S C S'.
"""

from math import log, sqrt
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.maps.result import Component

# Half axes, in sigmas, of an ellipse that holds a position in the plane with 95 %: all that is drawn has these.
SIGMAS_95: Final = sqrt(-2.0 * log(0.05))


class Shape(NamedTuple):
    """A component's tags in their own datum.

    Attributes:
        tag_covariances: (T, 2, 2) m^2 of the tags, in axes of the map.
        heading_sigma_rad: heading sigma of the rotation of all tags relative to the frame.
    """

    tag_covariances: FloatArray
    heading_sigma_rad: float

    @property
    def tag_sigmas_m(self) -> FloatArray:
        """Standard deviation (T,) of each tag along its worst direction."""
        return largest_sigmas_m(self.tag_covariances)


def largest_sigmas_m(covariances: FloatArray) -> FloatArray:
    """Return the standard deviation (T,) along the worst direction of covariances (T, 2, 2); NaN if unknown."""
    largest = np.full(len(covariances), np.nan)
    known = np.flatnonzero(np.isfinite(covariances).all(axis=(1, 2)))
    largest[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[known])[:, -1], 0.0))
    return largest


def drawn_covariances(component: Component) -> FloatArray:
    """Return the covariances (T, 2, 2) that pictures show: of the shape; relative to the frame if there is none."""
    shape = shape_of(component)
    if shape is not None:
        return shape.tag_covariances
    return np.array([tag.covariance for tag in component.tags]).reshape(-1, 2, 2)


def shape_of(component: Component) -> Shape | None:
    """Return the shape of a component; None with fewer than two tags, or if their covariances are unknown."""
    n = len(component.tags)
    covariance = component.tag_covariance
    if n < 2 or not np.isfinite(covariance).all():
        return None
    places = np.array([tag.position_m for tag in component.tags])
    common = common_motion(places)
    if common is None:
        return None
    heading_variance = common[:, 2] @ covariance @ common[:, 2] / ((places - places.mean(axis=0)) ** 2).sum()
    own = covariance.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
    tag_covariances = without_common_motion(own, common.T @ covariance, common)
    return Shape(tag_covariances, float(np.sqrt(max(heading_variance, 0.0))))


def without_common_motion(own: FloatArray, along: FloatArray, common: FloatArray) -> FloatArray:
    """Return the covariances (T, 2, 2) of single positions without their part along `common_motion`.

    These are the diagonal blocks of S C S'; the whole takes hundreds of MiB for thousands of tags, and so does the
    joint covariance C (2 T, 2 T) of all positions.

    Args:
        own: (T, 2, 2) diagonal blocks of C.
        along: (k, 2 T) G' C.
        common: (2 T, k) G, orthonormal.
    """
    n, k = len(common) // 2, common.shape[1]
    half = along.T - common @ (along @ common)  # S C G
    motion = common.reshape(n, 2, k)
    own = own - motion @ along.reshape(k, n, 2).transpose(1, 0, 2)
    return np.asarray(own - half.reshape(n, 2, k) @ motion.swapaxes(-1, -2))


def common_motion(places_m: FloatArray) -> FloatArray | None:
    """Return the orthonormal shift and rotation (2 T, 3) of positions (T, 2); None if they determine no rotation."""
    away = places_m - places_m.mean(axis=0)
    turned = np.stack([-away[:, 1], away[:, 0]], axis=-1).reshape(-1)
    if not turned.any():
        return None
    motion = np.column_stack([np.tile(np.eye(2), (len(away), 1)), turned])
    return np.asarray(motion / np.linalg.norm(motion, axis=0))
