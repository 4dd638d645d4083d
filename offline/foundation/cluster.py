"""Workers of a Dask cluster for the drives of a map, with the same results as in this process.

All that is asked of the cluster is tasks that are functions of their inputs (`cluster_task`), each under a key of its
own. So Dask computes what is lost with a worker again, from the logs if need be: nothing is scattered, no worker has
state, and this process keeps the futures of all results until it ends.
"""

import pickle
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, NamedTuple, TypeVar
from uuid import uuid4

import numpy as np
from distributed import Client, Future, KilledWorker, wait
from distributed.client import CancelledError

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.cluster_connection import Watch, connect
from groundsbot.offline.foundation.cluster_task import (
    ArrayInput,
    Item,
    Parcel,
    call,
    installed_versions,
    resident_of,
    result_of,
    run_parcel,
    step,
)
from groundsbot.offline.foundation.parcel import pack, unpack
from groundsbot.offline.foundation.stages import Progress, Stages
from groundsbot.offline.foundation.workers import Done, ResidentItems, TaskWorkers, Workers

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_Argument = TypeVar("_Argument")
_Array = np.ndarray[Any, Any]

_CLOSING_S: Final = 5.0  # for the scheduler to learn that this process is done


@contextmanager
def cluster_workers(address: str) -> Iterator["ClusterWorkers"]:
    """Yield the workers of a cluster; tasks that are left when the block ends, as by Ctrl-C, are cancelled.

    Args:
        address: address of the scheduler, tcp://HOST:PORT.

    Raises:
        OfflineError: there is no scheduler, or its workers cannot be used.
    """
    client = connect(address)
    watch = Watch(client, address)
    watch.start()
    try:
        yield ClusterWorkers(client, watch)
    finally:
        watch.stop()
        with suppress(OSError, TimeoutError, CancelledError):
            client.close(_CLOSING_S)  # the scheduler forgets the tasks of a client that leaves


class _Sent(NamedTuple):
    """An item for a worker, with its arrays, and the futures of the parcels that it depends on."""

    item: Item
    arrays: list[_Array]
    parcels: list[Future]


class Traffic(NamedTuple):
    """Bytes between this process and the cluster."""

    sent: int = 0
    received: int = 0


class ClusterWorkers(Workers):
    """The workers of a Dask cluster."""

    def __init__(self, client: Client, watch: Watch) -> None:
        """Begin without tasks.

        Args:
            client: connected to the scheduler.
            watch: watch of the same client.
        """
        super().__init__()
        self.is_this_process = False
        self.traffic = Traffic()
        self._client, self._watch = client, watch
        self._futures: dict[bytes, list[Future]] = defaultdict(list)  # of parcels, by the digests of their arrays

    @property
    def tasks(self) -> TaskWorkers:
        """These workers."""
        return self

    def hold(
        self, items: Sequence[_Item], names: Sequence[str], _sizes: Sequence[int] | None = None
    ) -> ResidentItems[_Item]:
        """Return items that stay on the cluster, which places them by itself."""
        return _ClusterItems(self, items, names)

    def _run_all(
        self,
        function: Callable[[_Item, Stages], _Result],
        items: Iterable[_Item],
        names: Sequence[str],
        notify: Progress,
        stage: str,
        tick: Callable[[], None],
    ) -> list[Done[_Result]]:
        sent = [self.send((function, item)) for item in items]

        def submit(i: int) -> Future:
            return self.submit(stage, run_parcel, installed_versions(), sent[i].item, stage, sent[i].parcels)

        futures, parcels = self.results(submit, names, tick)
        done = []
        for future in futures:
            own, parcel = sent.pop(0), parcels.pop(0)  # each ends with its result, so that no drive is held twice
            done.append(Done(self._unpack_result(own, parcel), parcel.costs))
            for digest in parcel.arrays:
                self._futures[digest].append(future)
        return done

    def send(self, value: object) -> _Sent:
        """Return an object as an item for a worker, without the arrays that the cluster has."""
        packed = pack(value)
        digests = packed.digests()
        parcels = _fewest(self._futures[digest] for digest in digests if digest in self._futures)
        number = {future.key: i for i, future in enumerate(parcels)}
        inputs, arrays = [], []
        for digest, array in zip(digests, packed.arrays, strict=True):
            found = [number[each.key] for each in self._futures.get(digest, ()) if each.key in number]
            inputs.append(ArrayInput(digest, found[0] if found else None))
            if not found:
                arrays.append(array)
        item = Item(packed.content, tuple(inputs), pickle.dumps(arrays))
        self._count(sent=len(item.content) + len(item.sent))
        return _Sent(item, packed.arrays, parcels)

    def _unpack_result(self, sent: _Sent, parcel: Parcel) -> Any:  # noqa: ANN401 (whatever the function returned)
        """Return the result in a parcel, with the arrays of the item where these are part of it."""
        self._count(received=len(parcel.content) + sum(each.nbytes for each in parcel.arrays.values()))
        arrays = [
            sent.arrays[place] if isinstance(place, int) else parcel.arrays[place].copy(order="K")
            for place in parcel.places
        ]
        return unpack(parcel.content, arrays)

    def _count(self, sent: int = 0, received: int = 0) -> None:
        self.traffic = Traffic(self.traffic.sent + sent, self.traffic.received + received)

    def submit(self, name: str, function: Callable[..., object], *arguments: object) -> Future:
        """Return the future of a function of the cluster; `name` is that of its kind on Dask's dashboard."""
        with warnings.catch_warnings(), self._watch.explain():
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            return self._client.submit(function, *arguments, key=f"{name}-{uuid4().hex}", pure=False)

    def call(self, name: str, function: Callable[..., object], *arguments: object) -> Future:
        """Return the future of a function's result, which stays on the cluster.

        Args:
            name: of its kind, as for `submit`.
            function: of its arguments alone, which it does not change; pickled by name.
            arguments: pickled; futures, also in lists, are replaced by their results on the worker.
        """
        return self.submit(name, call, installed_versions(), function, *arguments)

    def results(
        self, submit: Callable[[int], Future], names: Sequence[str], tick: Callable[[], None]
    ) -> tuple[list[Future], list[Any]]:
        """Submit a task for each name, and return their futures and results, in order.

        Args:
            submit: called with the number of a task.
            names: names of the tasks, for errors.
            tick: called as each result is there.

        Raises:
            OfflineError: a task ended several workers, or no worker or scheduler is left.
            Exception: raised by the first task of those that fail.
        """
        futures = [submit(i) for i in range(len(names))]
        found: dict[int, Any] = {}
        errors: dict[int, BaseException] = {}
        pending = set(range(len(names)))
        while pending:
            with self._watch.explain(), self._client.as_current():
                wait([futures[i] for i in pending], return_when="FIRST_COMPLETED")
            for i in sorted(i for i in pending if futures[i].done()):
                pending.discard(i)
                found[i], error = self._wait_for(futures[i])
                if error is None:
                    tick()
                    continue
                errors[i] = error
                if not isinstance(error, KilledWorker):  # the first one is raised, so later tasks do not matter
                    pending = {each for each in pending if each < i}
        for i, error in sorted(errors.items()):
            if isinstance(error, KilledWorker):
                # Dask holds a lost worker against all tasks that it had, so each is tried again alone.
                futures[i] = submit(i)
                found[i], error = self._wait_for(futures[i])
                tick()
            if error is not None:
                raise _blame(error, names[i])
        return futures, [found[i] for i in range(len(names))]

    def _wait_for(self, future: Future) -> tuple[Any, BaseException | None]:
        """Return the result of a task once it is there, or None and its error."""
        try:
            with self._watch.explain():
                return future.result(), None
        except Exception:
            if future.status != "error":
                raise
            return None, future.exception()


def _fewest(choices: Iterable[Sequence[Future]]) -> list[Future]:
    """Return few futures among which there is one of each choice: drives may have arrays that are alike."""
    found: dict[str, Future] = {}
    for choice in sorted(choices, key=len):
        if not any(each.key in found for each in choice):
            found[choice[0].key] = choice[0]
    return list(found.values())


def _blame(error: BaseException, name: str) -> BaseException:
    """Return the error of a task; one that names its drive where the task ends its workers."""
    if not isinstance(error, KilledWorker):
        return error
    return OfflineError(
        f"{name}: all workers that had it were killed, as systems do where memory is short; give the workers more "
        "memory, or leave it out"
    )


class _ClusterItems(ResidentItems[_Item]):
    """Items on a cluster: each call is a task that returns the item after it, from which the next call begins."""

    def __init__(self, workers: ClusterWorkers, items: Sequence[_Item], names: Sequence[str]) -> None:
        super().__init__((), names, ())
        self._workers = workers
        self._states: list[Future] = []
        for item in items:
            sent = workers.send(item)
            self._states.append(workers.submit("hold", resident_of, installed_versions(), sent.item, sent.parcels))

    def map(self, function: Callable[[_Item, _Argument], _Result], argument: _Argument) -> list[_Result]:
        """Return the results of a function for each item and an argument, in order."""
        call, states = pickle.dumps((function, argument)), self._states
        steps: dict[int, Future] = {}

        def submit(i: int) -> Future:
            steps[i] = self._workers.submit("step", step, installed_versions(), states[i], call)
            return self._workers.submit("result", result_of, steps[i])

        _, results = self._workers.results(submit, self._names, lambda: None)
        self._states = [steps[i] for i in range(len(states))]
        return [pickle.loads(each) for each in results]

    def release(self) -> None:
        """Remove the items from the cluster."""
        self._states = []
