"""Prior of tags that are mounted upright: vertical face and two level edges, to a sigma.

A tag may be rotated by multiples of 90 degrees: the prior applies to the axis that is closer to level.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.factors import SpatialColumns, SpatialState
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import Linearised

# Probability of a warning for a tag that is mounted upright to the sigma.
_FALSE_ALARM: Final = 1e-4


@dataclass(frozen=True)
class UprightFactors:
    """The factors r = (slope of the face's normal, slope of its level edges) / sigma, two residuals per tag.

    Attributes:
        tag: (U,) tag indices.
        sigma_rad: sigma of both slopes.
    """

    tag: IntArray
    sigma_rad: float

    def residual(self, state: SpatialState) -> FloatArray:
        """Return whitened residuals (U, 2)."""
        up, level = self._axes(state)
        return np.stack([up[:, 2], np.take_along_axis(up, level, 1)[:, 0]], axis=-1) / self.sigma_rad

    def linearise(self, state: SpatialState, columns: SpatialColumns) -> Linearised:
        """Return residuals (U, 2) and one block by the tags' rotations; R exp(d) has the bottom row u + u x d."""
        up, level = self._axes(state)
        x, y, z = up.T
        zero = np.zeros_like(x)
        cross = np.stack(
            [np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=-2
        )
        by_turn = np.stack([cross[:, 2], np.take_along_axis(cross, level[..., None], 1)[:, 0]], axis=1)
        return Linearised(self.residual(state), ((columns.turns[self.tag], by_turn / self.sigma_rad),))

    def warnings(self, state: SpatialState, tags: Sequence[TagKey]) -> list[str]:
        """Return a warning for each tag whose estimated slopes contradict the prior."""
        up, level = self._axes(state)
        slopes = np.stack([up[:, 2], np.take_along_axis(up, level, 1)[:, 0]], axis=-1)
        squares = (slopes**2).sum(axis=1) / self.sigma_rad**2
        return [
            f"tag {tags[t].tag_id} is not mounted upright to {degrees(self.sigma_rad):.2g} deg (--upright-deg): "
            f"despite this prior it leans by {degrees(slope[0]):.1f} deg and is rolled by {degrees(slope[1]):.1f} deg; "
            "omit the option, or mount the tag again"
            for t, slope, square in zip(self.tag.tolist(), slopes, squares, strict=True)
            if square > chdtri(2, _FALSE_ALARM)
        ]

    def _axes(self, state: SpatialState) -> tuple[FloatArray, IntArray]:
        """Return the vertical (U, 3) in the tags' axes, and the index (U, 1) of the axis that is closer to level."""
        up = state.turns[self.tag, 2]
        return up, np.argmin(np.abs(up[:, :2]), axis=1)[:, None]


NO_UPRIGHT_PRIOR: Final = UprightFactors(np.zeros(0, dtype=np.int64), 1.0)
