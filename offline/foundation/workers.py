"""Worker processes for the drives of a map; the results do not depend on their number.

Each worker is a pool of one process, so that the drive of a process that dies is known.
"""

import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, Protocol, TypeVar

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.process_start import METHOD, begin_worker, start_server
from groundsbot.offline.foundation.stages import Progress, StageCost, Stages, peak_mib

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_Argument = TypeVar("_Argument")

# A process takes more than a second to start, and logs of 4 MiB about twenty seconds to map.
_LEAST_BYTES: Final = 4 << 20
# Memory of a process with its libraries, and in addition for each byte of its log.
_PROCESS_BYTES: Final = 300 << 20
_BYTES_PER_BYTE: Final = 160
_MEMORY: Final = Path("/proc/meminfo")
_KILLED: Final = "was killed, as the system does where memory is short; give fewer --workers, or omit that option"


def default_workers(log_bytes: Sequence[int]) -> int:
    """Return the number of workers for logs of these sizes: the number of cores, or fewer where memory is short."""
    if sum(log_bytes) < _LEAST_BYTES:
        return 1
    return min(len(log_bytes), possible_workers(_BYTES_PER_BYTE * max(log_bytes)))


def possible_workers(own_bytes: int = 0) -> int:
    """Return the number of cores, or of processes with so much memory of their own that there is room for."""
    n, free = _n_cores(), _free_bytes()
    if free is not None:
        n = min(n, free // (_PROCESS_BYTES + own_bytes))
    return max(1, n)


def _n_cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _free_bytes() -> int | None:
    """Return the available memory; None where the system does not provide it."""
    with suppress(OSError):
        for line in _MEMORY.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    return None


class Done(NamedTuple, Generic[_Result]):
    """The result of a function for one item, and the costs of its stages."""

    result: _Result
    costs: tuple[StageCost, ...]


Handle = Any  # of a result that is with a worker, or the result itself


class TaskWorkers(Protocol):
    """Workers that call functions of their inputs alone, each perhaps on another computer."""

    def call(self, name: str, function: Callable[..., object], *arguments: object) -> Handle:
        """Return the handle of a function's result; handles among the arguments, also in lists, stand for results."""
        ...

    def results(
        self, submit: Callable[[int], Handle], names: Sequence[str], tick: Callable[[], None]
    ) -> tuple[list[Handle], list[Any]]:
        """Call `submit` with each number, again for one that is lost, and return the handles and their results."""
        ...


class Workers:
    """Worker processes, started when they are first needed; a single worker is this process."""

    def __init__(self, n: int = 1) -> None:
        """Begin without processes; `n` is the largest number of items in work at a time."""
        self.n = n
        self.is_this_process = n == 1  # whether the work is done here, and nothing pickled
        self._pools: list[ProcessPoolExecutor] = []
        self._process_ids: list[int] = []
        self._modules: list[str] = []  # to be imported by processes that are started

    def map(
        self,
        function: Callable[[_Item, Stages], _Result],
        items: Iterable[_Item],
        names: Sequence[str],
        stages: Stages,
        stage: str,
    ) -> list[_Result]:
        """Return the results of a function for each item, in order.

        Args:
            function: called with an item and the stages to record; pickled by name.
            items: one for each drive, taken when it is begun; pickled.
            names: names of the items, for the error where a process dies.
            stages: notified of each item that is done; records each stage's share of the elapsed time.
            stage: name for the work outside the function's own stages.

        Raises:
            OfflineError: a process was killed, as the system does where memory is short.
            Exception: raised by the function; that of the first failing item where there are several.
        """
        began_s = time.perf_counter()
        n_done = 0

        def tick() -> None:
            nonlocal n_done
            n_done += 1
            stages.notify(stage, n_done, len(names))

        stages.notify(stage, 0, len(names))
        stages.add([StageCost(stage, 0.0, 0.0, None)])  # so that it is listed before the stages within it
        done = self._run_all(function, items, names, stages.notify, stage, tick)
        worked_s = sum(cost.seconds for each in done for cost in each.costs)
        share = (time.perf_counter() - began_s) / max(worked_s, 1e-9)
        stages.add(cost._replace(seconds=share * cost.seconds) for each in done for cost in each.costs)
        return [each.result for each in done]

    @property
    def tasks(self) -> TaskWorkers | None:
        """Workers for tasks whose results stay with them: those of a cluster; None for processes of this computer."""
        return None

    def load_ahead(self, module: str, n_items: int) -> None:
        """Have the processes for some items import a module while this process does other things."""
        n = min(self.n, n_items)
        if n <= 1:
            return
        self._modules.append(module)
        if METHOD == "forkserver" and not self._pools:
            start_server(module)
        else:
            self._start(n)

    def begin(self, function: Callable[[_Item], _Result], item: _Item) -> Future[_Result]:
        """Begin a function in a process of its own, beside this one, and return its future; both are pickled."""
        self._start(1)
        return self._pools[0].submit(function, item)

    def begin_beside(self, function: Callable[[_Item], _Result], item: _Item, name: str) -> Callable[[], _Result]:
        """Begin a function in a process that was started before, beside this one, and return what waits for its result.

        These processes are taken in turn. Without one the function is called when its result is asked for.

        Args:
            function: pickled by name.
            item: pickled.
            name: name of the item, for the error where the process was killed.
        """
        if not self._pools:
            return partial(function, item)
        self._pools.append(self._pools.pop(0))
        future = self._pools[-1].submit(function, item)
        return lambda: _result(future, name)

    def hold(
        self, items: Sequence[_Item], names: Sequence[str], sizes: Sequence[int] | None = None
    ) -> "ResidentItems[_Item]":
        """Return items that each stay in one of the processes, for functions that are called on them repeatedly.

        Args:
            items: pickled.
            names: names of the items, for errors.
            sizes: by which the processes get equal shares of the items; None: all are equal.
        """
        n = min(self.n, len(items))
        if n <= 1:
            return ResidentItems(items, names, [])
        self._start(n)
        return ResidentItems(items, names, [self._pools[i] for i in equal_shares(sizes or [1] * len(items), n)])

    def _run_all(
        self,
        function: Callable[[_Item, Stages], _Result],
        items: Iterable[_Item],
        names: Sequence[str],
        notify: Progress,
        stage: str,
        tick: Callable[[], None],
    ) -> list[Done[_Result]]:
        """Return the results with their costs, in order; `tick` is called as each is there."""
        if min(self.n, len(names)) > 1:
            return self._distribute(function, items, names, stage, tick)
        done = []
        for item in items:
            done.append(run_item(function, item, stage, notify))
            tick()
        return done

    def _distribute(
        self,
        function: Callable[[_Item, Stages], _Result],
        items: Iterable[_Item],
        names: Sequence[str],
        stage: str,
        tick: Callable[[], None],
    ) -> list[Done[_Result]]:
        self._start(min(self.n, len(names)))
        left = iter(items)
        futures: list[Future[Done[_Result]]] = []
        busy: dict[Future[Done[_Result]], ProcessPoolExecutor] = {}
        idle = list(self._pools)
        while busy or (idle and len(futures) < len(names)):
            while idle and len(futures) < len(names):
                futures.append(idle[-1].submit(run_item, function, next(left), stage))
                busy[futures[-1]] = idle.pop()
            ended, _ = wait(busy, return_when=FIRST_COMPLETED)
            for each in ended:
                pool = busy.pop(each)
                if each.exception() is None:
                    idle.append(pool)
                    tick()
                else:
                    idle.clear()  # begin no more items after a failure
        return [_result(future, name) for future, name in zip(futures, names, strict=False)]

    def _start(self, n: int) -> None:
        context = get_context(METHOD)
        new = [ProcessPoolExecutor(1, context, begin_worker) for _ in range(n - len(self._pools))]
        self._pools += new
        try:
            self._process_ids += [each.result() for each in [pool.submit(os.getpid) for pool in new]]
        except (BrokenProcessPool, EOFError) as error:  # EOFError: the server
            raise OfflineError(f"a worker process {_KILLED}") from error
        for pool in new:
            for module in self._modules:
                pool.submit(import_module, module)

    def close(self, *, at_once: bool = False) -> None:
        """End the processes, after their present work or `at_once`."""
        for process_id in self._process_ids if at_once else ():
            with suppress(ProcessLookupError):
                os.kill(process_id, signal.SIGTERM)
        for pool in self._pools:
            pool.shutdown()
        self._pools, self._process_ids = [], []


class ResidentItems(Generic[_Item]):
    """Items that stay in worker processes, where functions may change them."""

    def __init__(self, items: Sequence[_Item], names: Sequence[str], pools: Sequence[ProcessPoolExecutor]) -> None:
        """Send the items to their processes.

        Args:
            items: pickled.
            names: names of the items, for errors.
            pools: the process of each item; empty where all stay in this one.
        """
        self._items, self._names, self._pools = list(items), names, pools
        self._call([(pool, i, item) for i, (pool, item) in enumerate(zip(pools, items, strict=bool(pools)))], _keep)

    def map(self, function: Callable[[_Item, _Argument], _Result], argument: _Argument) -> list[_Result]:
        """Return the results of a function for each item and an argument, in order.

        Raises:
            OfflineError: a process was killed.
        """
        if not self._pools:
            return [function(item, argument) for item in self._items]
        return self._call([(pool, i, function, argument) for i, pool in enumerate(self._pools)], _apply)

    def release(self) -> None:
        """Remove the items from the processes."""
        self._call([(pool, i) for i, pool in enumerate(self._pools)], _forget)

    def _call(self, calls: Sequence[tuple[Any, ...]], function: Callable[..., _Result]) -> list[_Result]:
        futures = [pool.submit(function, *arguments) for pool, *arguments in calls]
        return [_result(future, name) for future, name in zip(futures, self._names, strict=False)]


_RESIDENT: Final[dict[int, Any]] = {}  # in a worker process, items by index


def _keep(i: int, item: object) -> None:
    _RESIDENT[i] = item


def _apply(i: int, function: Callable[[Any, _Argument], _Result], argument: _Argument) -> _Result:
    return function(_RESIDENT[i], argument)


def _forget(i: int) -> None:
    _RESIDENT.pop(i, None)


def equal_shares(sizes: Sequence[int], n: int) -> list[int]:
    """Return which of n shares each item is in, the largest items first, each in the share that is smallest then.

    Graham, "Bounds on multiprocessing timing anomalies" (1969): the largest share is at most a third above the least
    possible.
    """
    found, in_all = [0] * len(sizes), [0] * n
    for i in sorted(range(len(sizes)), key=lambda i: -sizes[i]):
        found[i] = min(range(n), key=in_all.__getitem__)
        in_all[found[i]] += sizes[i]
    return found


@contextmanager
def worker_processes(n: int) -> Iterator[Workers]:
    """Yield workers whose processes end with the block; at once where it raises, as on Ctrl-C."""
    workers = Workers(n)
    try:
        yield workers
    except BaseException:
        workers.close(at_once=True)
        raise
    workers.close()


def run_item(
    function: Callable[[_Item, Stages], _Result], item: _Item, stage: str, notify: Progress | None = None
) -> Done[_Result]:
    """Return the result of a function for an item, with the costs of its stages; the rest is that of `stage`."""
    stages = Stages(notify)
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    result = function(item, stages)
    rest_s, rest_cpu_s = time.perf_counter() - began_s, time.process_time() - began_cpu_s
    for cost in stages.costs:
        rest_s, rest_cpu_s = rest_s - cost.seconds, rest_cpu_s - cost.cpu_seconds
    return Done(result, (StageCost(stage, rest_s, rest_cpu_s, peak_mib()), *stages.costs))


def _result(future: Future[_Result], name: str) -> _Result:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise OfflineError(f"{name}: its process {_KILLED}") from error
