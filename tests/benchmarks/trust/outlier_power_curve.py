"""How likely a tag is named, by how many foretold sigmas it was moved."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

CLEAR_SIGMAS: Final = 6.0
NAMED_SHARE: Final = 0.95
SIGMA_BINS: Final = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 25.0, 50.0, np.inf)


@dataclass(frozen=True)
class Told:
    """One tag that something was done to.

    Attributes:
        sigmas: by the shift and its foretold covariance; 0 where not seen on both sides.
        named: as a suspect; right: as of the right kind.
    """

    sigmas: float
    named: bool
    right: bool


def detection_curve(told: Sequence[Told]) -> list[tuple[float, float, int, float, float]]:
    """Least and most sigmas, how many tags, share named, share named right."""
    rows = []
    for low, high in pairwise(SIGMA_BINS):
        own = [each for each in told if low < each.sigmas <= high]
        if own:
            named, right = np.mean([each.named for each in own]), np.mean([each.right for each in own])
            rows.append((low, high, len(own), float(named), float(right)))
    return rows


def draw_curve(told: Mapping[str, Sequence[Told]], path: Path) -> None:
    """Share of tags named over how many foretold sigmas they were moved."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for kind, of_kind in told.items():
        # A bin of a tag or two says nothing.
        rows = [each for each in detection_curve(of_kind) if each[2] >= 10]
        at = [np.sqrt(max(low, 0.5) * min(high, 100.0)) for low, high, *_ in rows]
        if rows:
            axes.plot(at, [100.0 * each[4] for each in rows], "o-", ms=4, label=kind)
    axes.axvline(CLEAR_SIGMAS, color="0.6", lw=1)
    axes.axhline(100.0 * NAMED_SHARE, color="0.6", lw=1)
    axes.set(xscale="log", xlabel="shift, in sigmas foretold for the split", ylabel="named with the right kind, %")
    axes.set(ylim=(-3.0, 103.0))
    axes.set_xticks([1, 2, 3, 6, 10, 30, 100], ["1", "2", "3", "6", "10", "30", "100"])
    if axes.lines[2:]:
        axes.legend(frameon=False)
    figure.savefig(path, dpi=150)
