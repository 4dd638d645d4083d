"""Status of a recording as a small JSON file, which the recorder writes each second and `status` reads."""

import time
from collections import Counter, deque
from pathlib import Path
from typing import Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import atomic_write, read_regular
from groundsbot.onboard.errors import OnboardError

STATUS_SUFFIX: Final = ".status.json"
SERVICE_FOLDER: Final = Path("/run/groundsbot")  # of docs/robot/groundsbot-recorder.service

_NS_PER_S: Final = 1_000_000_000
_RATE_NS: Final = 5 * _NS_PER_S
_GROWTH_NS: Final = 120 * _NS_PER_S
_LEAST_GROWTH_NS: Final = 5 * _NS_PER_S
_STALE_S: Final = 5.0
_LATELY_NS: Final = 10 * _NS_PER_S
_MOST_BYTES: Final = 1 << 20


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class DeviceStatus(_Part):
    """Status of a device."""

    name: str
    rate_hz: float  # readings or pictures, over the last five seconds
    age_s: float | None  # since the newest one; None if there is none yet
    expected: bool  # robot.yaml has the device


class DiskStatus(_Part):
    """Status of the recorder's disk."""

    free_bytes: int
    bytes_per_s: float | None  # of this recording; None if not known yet
    hours_left: float | None  # until the disk is full at this rate; None if not known yet
    waiting_bytes: int  # in memory, not yet on the disk
    problem: str | None  # present problem, in words; None if there is none


class ProgressStatus(_Part):
    """Progress of the drive, as `recorder.Progress`."""

    driven_m: float
    tags_seen: int
    tags_seen_again: int


class Status(_Part):
    """Status of a recording."""

    format_version: Literal[1] = 1
    robot_id: str
    run_id: str
    folder: str
    pid: int
    state: Literal["recording", "stopping", "stopped"]
    updated_ns: int  # wall clock
    recording_s: float
    wheels: DeviceStatus
    camera: DeviceStatus
    # Of several cameras, by name; `camera` is the first.
    cameras: dict[str, DeviceStatus] = Field({}, exclude_if=lambda cameras: not cameras)
    gyro: DeviceStatus | None = None  # None without a gyro
    tags_in_view: list[str]  # empty while pictures are missing
    progress: ProgressStatus | None = None  # None in the status of an older recorder
    counts: dict[str, int]  # messages by topic that are on the disk
    losses: dict[str, int]  # since the start
    disk: DiskStatus
    clock_synchronised: bool
    stalled_s: float  # time without progress of the log
    problems: list[str]  # present problems, in words
    last_events: list[str]  # the newest of each kind, with the number of times


class RecordingSnapshot(NamedTuple):
    """State of a recording at one moment."""

    now_ns: int  # on the run's clock, like all times here
    counts: dict[str, int]  # of messages accepted
    newest_ns: dict[str, int]  # arrival of the newest message, by topic
    written_bytes: int
    losses: dict[str, int]


class Rates:
    """Rates from snapshots of counts."""

    def __init__(self) -> None:
        self._looks: deque[RecordingSnapshot] = deque()

    def add(self, look: RecordingSnapshot) -> None:
        """Add a snapshot."""
        self._looks.append(look)
        while look.now_ns - self._looks[0].now_ns > _GROWTH_NS:
            self._looks.popleft()

    def device(self, topic: str, name: str, expected: bool) -> DeviceStatus:
        """Return the status of the device of a topic."""
        if not self._looks:
            return DeviceStatus(name=name, rate_hz=0.0, age_s=None, expected=expected)
        last = self._looks[-1]
        first = next(look for look in self._looks if last.now_ns - look.now_ns <= _RATE_NS)
        elapsed_s = (last.now_ns - first.now_ns) / _NS_PER_S
        grown = last.counts.get(topic, 0) - first.counts.get(topic, 0)
        newest_ns = last.newest_ns.get(topic)
        age_s = None if newest_ns is None else round((last.now_ns - newest_ns) / _NS_PER_S, 3)
        return DeviceStatus(
            name=name, rate_hz=round(grown / elapsed_s, 2) if elapsed_s else 0.0, age_s=age_s, expected=expected
        )

    def lost_lately(self) -> dict[str, int]:
        """Return the losses of the last ten seconds."""
        if not self._looks:
            return {}
        last = self._looks[-1]
        first = next(look for look in self._looks if last.now_ns - look.now_ns <= _LATELY_NS)
        return dict(Counter(last.losses) - Counter(first.losses))

    def bytes_per_s(self) -> float | None:
        """Return the growth of the files over the last two minutes, or None if not known yet."""
        if not self._looks:
            return None
        first, last = self._looks[0], self._looks[-1]
        elapsed_ns = last.now_ns - first.now_ns
        if elapsed_ns < _LEAST_GROWTH_NS:
            return None
        return max(0.0, (last.written_bytes - first.written_bytes) * _NS_PER_S / elapsed_ns)


def write_status(status: Status, path: Path) -> str | None:
    """Write the file atomically; return the reason if that failed, else None."""
    try:
        with atomic_write(path, durable=False) as temporary, temporary.open("x", encoding="utf-8") as file:
            file.write(status.model_dump_json(indent=1))  # "x": do not follow a link
    except OSError as error:
        return error.strerror or str(error)
    return None


def read_status(place: Path) -> Status:
    """Return the status in a file, or the newest one in a folder of recordings, or of the service.

    Args:
        place: a status file; or a folder for run folders. If that has no status, the service's is returned if it
            records into that folder, or whatever its folder if `place` is the current one.

    Raises:
        OnboardError: there is no status file, or it is invalid.
    """
    if not place.is_dir():
        return _read(place)
    found = _newest_in(place)
    if found is not None:
        return _read(found)
    found = _newest_in(SERVICE_FOLDER)
    if found is not None:
        status = _read(found)
        if place == Path() or Path(status.folder).parent.resolve() == place.resolve():
            return status
    raise OnboardError(
        f"{place}: there is no status of a recorder, or you may not read it; give the --output or --status of `record`"
    )


def _newest_in(folder: Path) -> Path | None:
    found = [path for path in folder.glob(f"*{STATUS_SUFFIX}") if path.is_file()]  # excludes dangling links
    return max(found, key=lambda path: path.stat().st_mtime_ns, default=None)


def _read(path: Path) -> Status:
    if not path.is_file():
        raise OnboardError(f"{path}: there is no status of a recorder; give the --output or --status of `record`")
    try:
        return Status.model_validate_json(read_regular(path, _MOST_BYTES))
    except (ValidationError, OSError, CalibError) as error:
        raise OnboardError(f"{path}: is not a status of a recorder ({type(error).__name__}); remove it") from None


def is_alive(status: Status) -> bool:
    """Return whether the recorder still runs, by the age of its status, which it writes every second."""
    age_s = (time.time_ns() - status.updated_ns) / _NS_PER_S
    return status.state != "stopped" and abs(age_s) < _STALE_S
