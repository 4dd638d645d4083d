"""What runs on the workers of a Dask cluster: functions of their inputs alone, so that what is lost is computed again.

Nothing that a worker keeps for others is changed here: inputs are copied out of the parcels of earlier tasks.
"""

import pickle
import platform
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.parcel import pack, unpack
from groundsbot.offline.foundation.stages import StageCost
from groundsbot.offline.foundation.workers import run_item

_Array = np.ndarray[Any, Any]

# Results depend on these; with other ones of `distributed` the connection is not supported.
PACKAGES: Final = ("groundsbot", "distributed", "numpy", "scipy", "numba", "opencv-contrib-python-headless")
SOURCES: Final = "sources of groundsbot"
_PACKAGE: Final = Path(__file__).parents[2]


class ArrayInput(NamedTuple):
    """Where a worker finds an array of an item.

    Attributes:
        digest: digest of the array.
        parcel: number of the parcel, among those the task depends on, that has it; None: it is sent with the item.
    """

    digest: bytes
    parcel: int | None


class Item(NamedTuple):
    """A function and an item, as sent to a worker.

    Attributes:
        content: content of `Packed`, for a tuple of the function and the item.
        inputs: inputs of each array.
        sent: pickled list of the arrays that no parcel has, in order.
    """

    content: bytes
    inputs: tuple[ArrayInput, ...]
    sent: bytes


class Parcel(NamedTuple):
    """A result on a worker.

    Attributes:
        content: content of `Packed`.
        places: places of each array: number of the input that it is, or its digest.
        arrays: arrays by digest; those that are not inputs.
        costs: costs of the stages.
    """

    content: bytes
    places: tuple[int | bytes, ...]
    arrays: dict[bytes, _Array]
    costs: tuple[StageCost, ...]


def run_parcel(versions: Mapping[str, str], item: Item, stage: str, parcels: Sequence[Parcel]) -> Parcel:
    """Return the result of a function for an item, with the costs of its stages.

    Raises:
        OfflineError: this worker has other versions, or an input was computed again and is another one.
        Exception: raised by the function.
    """
    check_versions(versions, installed_versions(), worker_name())
    inputs = _inputs(item, parcels)
    function, argument = unpack(item.content, inputs)
    done = run_item(function, argument, stage)
    packed = pack(done.result)
    numbers = {id(array): number for number, array in enumerate(inputs)}
    places: list[int | bytes] = []
    arrays: dict[bytes, _Array] = {}
    for array, digest in zip(packed.arrays, packed.digests(), strict=True):
        number = numbers.get(id(array))
        if number is not None and item.inputs[number].digest == digest:  # the function did not change it
            places.append(number)
        else:
            places.append(digest)
            arrays[digest] = array
    return Parcel(packed.content, tuple(places), arrays, done.costs)


class Resident(NamedTuple):
    """An item that stays on the cluster, and what the last function called on it returned; both pickled."""

    item: bytes
    result: bytes = b""


def resident_of(versions: Mapping[str, str], item: Item, parcels: Sequence[Parcel]) -> Resident:
    """Return an item that is to stay on the cluster."""
    check_versions(versions, installed_versions(), worker_name())
    return Resident(pickle.dumps(unpack(item.content, _inputs(item, parcels))))


def step(versions: Mapping[str, str], resident: Resident, call: bytes) -> Resident:
    """Return a resident item after a function was called on it.

    Args:
        versions: versions of the process that asks.
        resident: not changed, since it is the input again where the result is lost.
        call: pickled function and argument.
    """
    check_versions(versions, installed_versions(), worker_name())
    item = pickle.loads(resident.item)
    function, argument = pickle.loads(call)
    result = function(item, argument)
    return Resident(pickle.dumps(item), pickle.dumps(result))


def result_of(resident: Resident) -> bytes:
    """Return the result of the last function."""
    return resident.result


def _inputs(item: Item, parcels: Sequence[Parcel]) -> list[_Array]:
    sent = iter(pickle.loads(item.sent))
    found = []
    for each in item.inputs:
        if each.parcel is None:
            found.append(next(sent))
            continue
        array = parcels[each.parcel].arrays.get(each.digest)
        if array is None:
            raise OfflineError(
                f"{worker_name()}: a result that was lost with a worker was computed again with other values; all "
                "workers must have the same kind of processor"
            )
        found.append(array.copy(order="K"))
    return found


def call(versions: Mapping[str, str], function: Callable[..., object], *arguments: object) -> object:
    """Return the result of a function of its arguments alone, which it does not change.

    Raises:
        OfflineError: this worker has other versions.
        Exception: raised by the function.
    """
    check_versions(versions, installed_versions(), worker_name())
    return function(*arguments)


def worker_name() -> str | None:
    """Return the worker of a cluster that runs this task, by its address and computer; None in any other process."""
    distributed = sys.modules.get("distributed")
    try:
        return None if distributed is None else f"worker {distributed.get_worker().address} on {socket.gethostname()}"
    except ValueError:  # called outside of a task
        return None


@cache
def installed_versions() -> dict[str, str]:
    """Return the versions of what results depend on, and a hash of the sources, which tells revisions apart."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found | {SOURCES: sources_hash()}


def check_versions(here: Mapping[str, str], there: Mapping[str, str | None], name: str | None) -> None:
    """Check that a worker or scheduler has the versions of this process, of all that it states.

    Raises:
        OfflineError: naming it and both versions.
    """
    for package, own in here.items():
        other = there.get(package, own)
        if other != own:
            kind = package if package == SOURCES else f"{package} version"
            raise OfflineError(
                f"{name}: {kind} {other or 'none'}, but {own} here; install the same environment on all computers of "
                "the cluster, and start its scheduler and workers again"
            )


def sources_hash(package: Path = _PACKAGE) -> str:
    """Return a hash of all source files of the folders that a map is made with."""
    digest = sha256()
    for room in ("calib", "onboard", "offline"):
        for path in sorted((package / room).rglob("*.py")):
            digest.update(str(path.relative_to(package)).encode() + path.read_bytes())
    return digest.hexdigest()[:12]
