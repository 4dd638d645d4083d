"""Folders of at most 1 MiB with many logs, or with many files of one run, made to take memory and time."""

from collections.abc import Callable
from pathlib import Path
from typing import Final, TypedDict

from mcap.records import Channel, Schema

from groundsbot.onboard.log.messages import (
    TOPICS,
    PlanarOdometry,
    RunInfo,
    TagObservation,
    TagObservations,
    WheelEncoders,
)
from tests.support.data.logs import ROBOT_YAML, START_NS
from tests.support.hostile.log_bytes import LIMIT_BYTES, MS, NUMBERS, bytes_of, chunk, log, message
from tests.support.hostile.logs import observe

_MANY: Final = 1000
_TOPICS: Final = ("/run", "/wheels", "/odometry", "/tags/observations")


def _small(records: bytes, run_id: str, robot_yaml: str = ROBOT_YAML) -> bytes:
    """A log of some messages in few bytes."""
    schemas = [
        Schema(id=NUMBERS[name], data=b"", encoding="protobuf", name=TOPICS[name].schema.DESCRIPTOR.full_name)
        for name in _TOPICS
    ]
    channels = [
        Channel(id=NUMBERS[name], topic=name, message_encoding="protobuf", metadata={}, schema_id=NUMBERS[name])
        for name in _TOPICS
    ]
    run = message("/run", RunInfo(run_id=run_id, robot_id="gb1", robot_yaml=robot_yaml))
    return log(chunk(bytes_of(*schemas, *channels) + run + records))


def _drive(looks: int, n_tags: int, first_tag: int) -> bytes:
    """The messages of a drive of a metre past tags that stay where they are."""
    records = b""
    for index in range(looks):
        at_ns, rolled_m = START_NS + index * 100 * MS, 0.1 * index
        rolled = PlanarOdometry.WheelDistances(left_m=rolled_m, right_m=rolled_m)
        places = [TagObservation.Cartesian(x_m=2.0 - rolled_m, y_m=0.5 * k) for k in range(n_tags)]
        tags = [
            TagObservation(family="tag36h11", tag_id=first_tag + k, cartesian=place) for k, place in enumerate(places)
        ]
        records += message("/odometry", PlanarOdometry(stamp_ns=at_ns, wheels=rolled), at_ns)
        seen = TagObservations(stamp_ns=at_ns, frame="base", observations=tags)
        records += message("/tags/observations", seen, at_ns)
    return records


def _runs(make: Callable[[int], bytes], count: int = _MANY) -> Callable[[Path], Path]:
    """A folder of runs; `make` takes each one's number."""

    def write(folder: Path) -> Path:
        for number in range(count):
            (folder / f"{number:04d}").mkdir(parents=True)
            (folder / f"{number:04d}" / "0000.core.mcap").write_bytes(make(number))
        return folder

    return write


class _Of(TypedDict):
    """What is different in each of some runs."""

    run_id: str
    size_bytes: int


def _full_runs(count: int, make: Callable[[_Of], bytes]) -> Callable[[Path], Path]:
    """So many runs that fill the limit."""
    size_bytes = (LIMIT_BYTES - 30_000) // count
    return _runs(lambda number: make(_Of(run_id=str(number), size_bytes=size_bytes)), count)


def _mirror(of: _Of) -> float:
    """Tags lie to the left in every second run: each two are as far apart in all, and no three fit."""
    return -0.5 if int(of["run_id"]) % 2 else 0.5


def _segments(make: Callable[[int], bytes], count: int = _MANY) -> Callable[[Path], Path]:
    """The folder of one run in so many files."""

    def write(folder: Path) -> Path:
        folder.mkdir()
        for number in range(count):
            (folder / f"{number:04d}.core.mcap").write_bytes(make(number))
        return folder

    return write


def _empty_observations(count: int) -> bytes:
    return message("/wheels", WheelEncoders()) * count


def _long_yaml(number: int) -> bytes:
    batches = "{default_size_m: 0.1}, " * 500
    return _small(b"", str(number), ROBOT_YAML.replace("tags:", f"tags: [{batches}]\nother:"))


FOLDERS: Final[dict[str, Callable[[Path], Path]]] = {
    "a thousand runs past ten tags": _runs(lambda number: _small(_drive(10, 10, 0), str(number))),
    "a thousand runs that share nothing": _runs(lambda number: _small(_drive(10, 10, 10 * number), str(number))),
    "a thousand runs without a tag": _runs(lambda number: _small(_drive(10, 0, 0), str(number))),
    "a thousand copies of a run": _runs(lambda _: _small(_drive(10, 10, 0), "r")),
    "a thousand bombs": _runs(lambda number: _small(_empty_observations(30_000), str(number))),
    "a thousand long robot.yamls": _runs(_long_yaml),
    "as many runs as may be": _full_runs(40, lambda of: observe(50, 18, 18, 0.041, agree=True, apart_m=0.5, **of)),
    "as many runs as may be, at odds": _full_runs(40, lambda of: observe(50, 18, 18, **of)),
    "as many runs as may be, mirrored": _full_runs(
        40, lambda of: observe(50, 18, 18, 0.041, agree=True, apart_m=_mirror(of), **of)
    ),
    "as many long runs as may be": _full_runs(40, lambda of: observe(230, 18, 4, 0.041, agree=True, apart_m=0.5, **of)),
    "ten runs past eighty tags": _full_runs(10, lambda of: observe(100, 80, 40, 0.041, agree=True, apart_m=0.5, **of)),
    "two runs past four hundred tags": _full_runs(
        2, lambda of: observe(50, 400, 400, 0.041, agree=True, apart_m=0.5, **of)
    ),
    "two runs past four hundred tags, mirrored": _full_runs(
        2, lambda of: observe(50, 400, 400, 0.041, agree=True, apart_m=_mirror(of), **of)
    ),
}
"""Of several runs."""

RUN_FOLDERS: Final[dict[str, Callable[[Path], Path]]] = {
    "a thousand files of one run": _segments(lambda _: _small(_drive(10, 10, 0), "r")),
    "a thousand bombs of one run": _segments(lambda _: _small(_empty_observations(30_000), "r")),
}
"""Of one run."""
