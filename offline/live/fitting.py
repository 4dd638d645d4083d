"""Fits of noise and calibration to drives under way, which take longer than an update, in a process besides it."""

import os
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Final

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.foundation import Workers
from groundsbot.offline.mapping import Diagnostics, EarlierMap, build_map
from groundsbot.offline.measurements import Run

# A fit begins when the drives have grown by this factor since the last one: its result changes with their logarithm.
GROWTH: Final = 1.5
_NICE: Final = 19  # an update must not wait for a fit, even on one core


@dataclass(frozen=True)
class FitResult:
    """Result of a fit: what maps take from it, or why there is none."""

    earlier: EarlierMap | None
    trouble: str = ""


class Fitting:
    """Repeated fits to growing drives; at most one at a time."""

    def __init__(self, noise: NoiseParameters | None = None, workers: Workers | None = None) -> None:
        """Begin without a fit.

        Args:
            noise: sigmas given by the user, which are not fitted.
            workers: where a process for the fits is started; None: they are made at once, in this process.
        """
        self._noise = noise
        self._workers = workers
        self._fitted_messages = 0
        self._future: Future[FitResult] | None = None

    @property
    def is_in_background(self) -> bool:
        """Whether fits are made in a process of their own."""
        return self._workers is not None

    def offer(self, runs: Sequence[Run], n_messages: int) -> None:
        """Begin a fit if none is under way and the drives have grown enough since the last one.

        Args:
            runs: the drives up to now.
            n_messages: number of messages that they were made from.
        """
        if self._future is not None or n_messages < GROWTH * self._fitted_messages:
            return
        self._fitted_messages = n_messages
        item = _Drives(tuple(runs), self._noise)
        if self._workers is not None:
            self._future = self._workers.begin(_fit_nicely, item)
            return
        self._future = Future()
        self._future.set_result(fit(item))

    def take(self) -> FitResult | None:
        """Return the result of a fit that has ended since the last call, or None."""
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        try:
            return future.result()
        except BrokenProcessPool:
            return FitResult(None, "the process that fits noise and calibration was killed; is memory short?")
        except Exception as error:  # the drives go on, and the map with the last fit, too
            return FitResult(None, f"noise and calibration cannot be fitted: {type(error).__name__}: {error}")


@dataclass(frozen=True)
class _Drives:
    """Drives, and the noise if it is given."""

    runs: tuple[Run, ...]
    noise: NoiseParameters | None


def fit(drives: _Drives) -> FitResult:
    """Map drives as `map` does, and return their noise and calibration."""
    workings = Diagnostics()
    try:
        result = build_map(drives.runs, drives.noise, workings=workings)
    except GroundsbotError as error:
        return FitResult(None, str(error))
    if workings.freed is None:
        raise ValueError("a map without self-calibration")
    return FitResult(EarlierMap(result.noise, result.noise_fit, workings.freed._replace(runs=[])))


def _fit_nicely(drives: _Drives) -> FitResult:
    os.nice(_NICE)
    return fit(drives)
