"""What the mapping is doing: told while it works, and the seconds and memory of each stage when it is done."""

import ctypes
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

Progress = Callable[[str, int, int], None]  # what is being done, how many are done, of how many
Tick = Callable[[], None]  # one more is done

_STATUS: Final = Path("/proc/self/status")
_TRIM: Final = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None


class StageCost(NamedTuple):
    """What one stage took."""

    name: str
    seconds: float  # that passed; of work in several processes at once its share of them
    cpu_seconds: float  # of processors, on all threads and in all processes
    peak_mib: float | None  # the most memory that one process held until the stage's end; None where no kernel tells


class Stages:
    """Tells somebody of each stage as it begins and goes on, and keeps what each took."""

    def __init__(self, tell: Progress | None = None) -> None:
        """Args: tell: told at a stage's beginning and whenever one of its parts is done; None: nobody is."""
        self.tell: Final = tell or (lambda _what, _done, _total: None)
        self._costs: dict[str, StageCost] = {}

    @contextmanager
    def stage(self, name: str, total: int = 1) -> Iterator[Tick]:
        """Times the block as (another part of) a stage of `total` parts; yields what to call when a part is done."""
        done = 0

        def tick() -> None:
            nonlocal done
            done += 1
            self.tell(name, done, total)

        self.tell(name, 0, total)
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        try:
            yield tick
        finally:
            seconds, cpu_seconds = time.perf_counter() - began_s, time.process_time() - began_cpu_s
            self.add([StageCost(name, seconds, cpu_seconds, peak_mib())])
            _give_back()

    def add(self, costs: Iterable[StageCost]) -> None:
        """Adds what stages took, in this process or in another one."""
        for each in costs:
            before = self._costs.get(each.name, StageCost(each.name, 0.0, 0.0, None))
            peaks = [peak for peak in (before.peak_mib, each.peak_mib) if peak is not None]
            self._costs[each.name] = StageCost(
                each.name,
                before.seconds + each.seconds,
                before.cpu_seconds + each.cpu_seconds,
                max(peaks, default=None),
            )

    @property
    def costs(self) -> tuple[StageCost, ...]:
        """Each stage so far, in order of their beginnings."""
        return tuple(self._costs.values())


def _give_back() -> None:
    """Returns to the system what the block has let go of: the C library keeps arrays of up to 32 MiB for later.

    By malloc_trim(3), which glibc has; it takes milliseconds.
    """
    if _TRIM is not None:
        _TRIM(0)


def peak_mib() -> float | None:
    """The kernel's high-water mark of this process's memory, which Linux alone tells without what its parent held."""
    try:
        lines = _STATUS.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:")), None)
