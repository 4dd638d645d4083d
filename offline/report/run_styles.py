"""Colours and dashes that distinguish runs, alike in report.html and map.png."""

from collections.abc import Iterable
from itertools import cycle, product
from typing import Final, NamedTuple

# Okabe and Ito, "Color universal design" (2008), without those too pale for lines.
_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# Solid, dashed, dash-dotted, dash-dot-dotted, in widths of the line; dots alone are for what is not part of the map.
_DASHES: Final[tuple[tuple[float, ...], ...]] = ((), (5.0, 2.0), (6.0, 2.0, 1.0, 2.0), (6.0, 2.0, 1.0, 2.0, 1.0, 2.0))
N_STYLES: Final = len(_COLOURS) * len(_DASHES)  # that differ


class RunStyle(NamedTuple):
    """How a run's lines look; `dashes` are lengths of dashes and gaps in widths of the line, none for a solid one."""

    colour: str
    dashes: tuple[float, ...]


def run_styles(runs: Iterable[str]) -> dict[str, RunStyle]:
    """Return the style of each run by name; `N_STYLES` differ, the first six in their colours alone."""
    styles = (RunStyle(colour, dashes) for dashes, colour in cycle(product(_DASHES, _COLOURS)))
    return dict(zip(dict.fromkeys(runs), styles, strict=False))
