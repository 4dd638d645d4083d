"""Covariances of a component's tags relative to each other, without the uncertainty of the frame.

The joint covariance of the tags is transformed to the datum of the tags themselves (S-transformation: Baarda 1973,
"S-transformations and criterion matrices"). With G (2T, 3) the Jacobian with respect to a small shift and rotation of
all tags, S = I - G (G'G)^-1 G' projects onto the shape, whose covariance is S C S'.
"""

from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.maps.result import Component


class Shape(NamedTuple):
    """A component's tags in their own datum.

    Attributes:
        tag_covariances: (T, 2, 2) m^2 of the tags, in axes of the map.
        heading_sigma_rad: of the rotation of all tags relative to the frame.
    """

    tag_covariances: FloatArray
    heading_sigma_rad: float

    @property
    def tag_sigmas_m(self) -> FloatArray:
        """Standard deviation (T,) of each tag along its worst direction."""
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(self.tag_covariances)[:, -1], 0.0)))


def shape_of(component: Component) -> Shape | None:
    """Return the shape of a component; None with fewer than two tags, or if their covariances are unknown."""
    n = len(component.tags)
    covariance = component.tag_covariance
    if n < 2 or not np.isfinite(covariance).all():
        return None
    places = np.array([tag.position_m for tag in component.tags])
    away = places - places.mean(axis=0)
    turned = np.stack([-away[:, 1], away[:, 0]], axis=-1).reshape(-1)
    length2 = float(turned @ turned)
    if length2 == 0.0:
        return None
    gauge = np.column_stack([np.tile([1.0, 0.0], n), np.tile([0.0, 1.0], n), turned])
    scaled = gauge / np.sqrt((gauge**2).sum(axis=0))  # the three columns are orthogonal
    projection = np.eye(2 * n) - scaled @ scaled.T
    own = (projection @ covariance @ projection).reshape(n, 2, n, 2)
    heading_variance = float(turned @ covariance @ turned) / length2**2
    return Shape(own[np.arange(n), :, np.arange(n)], float(np.sqrt(max(heading_variance, 0.0))))
