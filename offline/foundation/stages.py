"""Reports the progress of stages of work, and records the time and memory of each."""

import ctypes
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

Progress = Callable[[str, int, int], None]  # name of the stage, number of parts done, number of all parts
Tick = Callable[[], None]  # to be called when a part is done

_STATUS: Final = Path("/proc/self/status")
_TRIM: Final = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None


class StageCost(NamedTuple):
    """The time and memory of one stage.

    Attributes:
        name: name of the stage.
        seconds: elapsed; for work in several processes at once, the stage's share.
        cpu_seconds: CPU time of all threads and processes.
        peak_mib: largest memory of one process until the end of the stage; None where the system does not provide it.
    """

    name: str
    seconds: float
    cpu_seconds: float
    peak_mib: float | None


class Stages:
    """A recorder of stages, which also reports their progress."""

    def __init__(self, notify: Progress | None = None) -> None:
        """Begin without stages; `notify` is called at the beginning of a stage and when one of its parts is done."""
        self.notify: Final = notify or (lambda _name, _done, _total: None)
        self._costs: dict[str, StageCost] = {}

    @contextmanager
    def stage(self, name: str, total: int = 1) -> Iterator[Tick]:
        """Time the block as a stage of `total` parts, and yield a function to call when a part is done.

        Blocks of the same name are added up.
        """
        done = 0

        def tick() -> None:
            nonlocal done
            done += 1
            self.notify(name, done, total)

        self.notify(name, 0, total)
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        try:
            yield tick
        finally:
            seconds, cpu_seconds = time.perf_counter() - began_s, time.process_time() - began_cpu_s
            self.add([StageCost(name, seconds, cpu_seconds, peak_mib())])

    def add(self, costs: Iterable[StageCost]) -> None:
        """Add the costs of stages that ended, in this process or in another one, and release what they freed."""
        for each in costs:
            before = self._costs.get(each.name, StageCost(each.name, 0.0, 0.0, None))
            peaks = [peak for peak in (before.peak_mib, each.peak_mib) if peak is not None]
            self._costs[each.name] = StageCost(
                each.name,
                before.seconds + each.seconds,
                before.cpu_seconds + each.cpu_seconds,
                max(peaks, default=None),
            )
        release_memory()

    @property
    def costs(self) -> tuple[StageCost, ...]:
        """The costs of all stages so far, in order of their beginnings."""
        return tuple(self._costs.values())


def release_memory() -> None:
    """Return free memory to the system, because the C library keeps freed arrays of up to 32 MiB.

    This calls malloc_trim(3) of glibc, which takes milliseconds.
    """
    if _TRIM is not None:
        _TRIM(0)


def peak_mib() -> float | None:
    """Return the peak memory of this process by the kernel, without that of its parent; None where not on Linux."""
    try:
        lines = _STATUS.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:")), None)
