"""Tags that somebody knows to hang upright: faces vertical, two edges level, each to a sigma.

A tag printed on its side hangs upright too: of its two axes that one is held level which is nearer to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.factors import SpatialColumns, SpatialState
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import Linearised

# A level tells a hundredth of a degree at best; what leans by ten is not upright.
# A tag that hangs as its sigma says is named as leaning so rarely.
_FALSE_ALARM: Final = 1e-4


@dataclass(frozen=True)
class UprightFactors:
    """r = (slope of the face's normal, slope of its level edges) / sigma, two numbers a tag.

    Attributes:
        tag: (U,) indices.
        sigma_rad: of both.
    """

    tag: IntArray
    sigma_rad: float

    def residual(self, state: SpatialState) -> FloatArray:
        """(U, 2), whitened."""
        up, level = self._axes(state)
        return np.stack([up[:, 2], np.take_along_axis(up, level, 1)[:, 0]], axis=-1) / self.sigma_rad

    def linearise(self, state: SpatialState, columns: SpatialColumns) -> Linearised:
        """Residuals (U, 2) and one block by the tags' turns: R exp(d) has the bottom row u + u x d."""
        up, level = self._axes(state)
        x, y, z = up.T
        zero = np.zeros_like(x)
        cross = np.stack(
            [np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=-2
        )
        by_turn = np.stack([cross[:, 2], np.take_along_axis(cross, level[..., None], 1)[:, 0]], axis=1)
        return Linearised(self.residual(state), ((columns.turns[self.tag], by_turn / self.sigma_rad),))

    def leaning(self, state: SpatialState, tags: Sequence[TagKey]) -> list[str]:
        """A sentence for each tag that hangs otherwise by more than chance allows."""
        up, level = self._axes(state)
        slopes = np.stack([up[:, 2], np.take_along_axis(up, level, 1)[:, 0]], axis=-1)
        squares = (slopes**2).sum(axis=1) / self.sigma_rad**2
        return [
            f"tag {tags[t].tag_id} does not hang upright to {degrees(self.sigma_rad):.2g} deg, as --upright-deg says: "
            f"even held so it leans by {degrees(slope[0]):.1f} deg and is rolled by {degrees(slope[1]):.1f} deg; "
            "leave the option out, or hang it anew"
            for t, slope, square in zip(self.tag.tolist(), slopes, squares, strict=True)
            if square > chi2.isf(_FALSE_ALARM, 2)
        ]

    def _axes(self, state: SpatialState) -> tuple[FloatArray, IntArray]:
        """(U, 3) map's vertical in the tags' axes, and (U, 1) which of their first two axes is nearer to level."""
        up = state.turns[self.tag, 2]
        return up, np.argmin(np.abs(up[:, :2]), axis=1)[:, None]


NOTHING_UPRIGHT: Final = UprightFactors(np.zeros(0, dtype=np.int64), 1.0)
