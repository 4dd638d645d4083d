"""Compiled inner loops: numba with its cache on disk, and without where nothing may be written."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., object])


def jitted(function: _F) -> _F:
    """Compiled on first call; kept on disk beside the source, or in the user's cache folder, where that can be written.

    Sums are contracted into fused multiply-adds but never reordered, so that a result does not depend on the machine's
    vector width.
    """
    try:
        compiled = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})(function)
    except RuntimeError:  # numba found no folder that it may write to
        compiled = numba.njit(error_model="numpy", fastmath={"contract"})(function)
    return cast("_F", compiled)
