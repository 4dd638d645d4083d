"""A folder into which another program writes pictures, as a camera."""

import os
import re
import time
from pathlib import Path
from typing import Final

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import MOST_PIXELS, is_complete, read_regular
from groundsbot.onboard.camera.camera import Camera, CameraLostError, Frame
from groundsbot.onboard.log import StampSource
from groundsbot.onboard.process import RunClock

_NS_PER_S: Final = 1_000_000_000
_PICTURE_NAME: Final = re.compile(r"(\d{1,19})\.(?:png|jpe?g)", re.IGNORECASE)
_POLL_S: Final = 0.02
_REST: Final = 5.0
_SETTLE_NS: Final = 50_000_000
_UNFINISHED_LIMIT_NS: Final = _NS_PER_S
_CLOCK_TOLERANCE_NS: Final = 100_000_000
_AT_ONCE: Final = 8  # pictures per read
_MOST_BYTES: Final = MOST_PIXELS  # of one picture; grey takes at most a byte per pixel. It limits the memory of a queue


class FolderCamera(Camera):
    """A folder of `<t_ns>.png` or `.jpg`, which are read as they appear.

    The name of a picture is the middle of its exposure on the host's wall clock. A file without its end marker is
    still being written and is read later. If it has not changed for a second, it is returned as it is, and the decoder
    refuses it. Anything but a regular file of limited size is refused without being opened.
    """

    patience_s = 2.0
    drains = True

    def __init__(self, folder: Path, clock: RunClock, since_ns: int) -> None:
        self._folder = folder
        self._clock = clock
        self._since_ns = since_ns
        self._seen: set[str] = set()  # names still in the folder that were read
        self._unfinished: dict[str, tuple[int, int]] = {}  # name: (bytes, time of the last change)
        self._changed_ns = -1
        self._settled = False
        self._sequence = 0

    def open(self) -> list[str]:
        """See Camera."""
        if not self._folder.is_dir():
            raise CameraLostError(f"{self._folder} is neither a folder of pictures, a video file nor under /dev")
        return []

    def read(self, timeout_s: float) -> list[Frame]:
        """See Camera."""
        deadline_ns = self._clock.now_ns() + round(timeout_s * _NS_PER_S)
        while True:
            begun_s = time.monotonic()
            frames = self._scan()
            if frames or self._clock.now_ns() >= deadline_ns:
                return frames
            # Stamps come from names, so a large folder, which takes long to list, may be listed less often.
            time.sleep(max(_POLL_S, _REST * (time.monotonic() - begun_s)))

    def close(self) -> None:
        """See Camera."""

    def _scan(self) -> list[Frame]:
        try:
            now_ns, changed_ns = time.time_ns(), self._folder.stat().st_mtime_ns
            if changed_ns == self._changed_ns and self._settled and not self._unfinished:
                return []
            # The modification time of a folder is coarser than the time between two scans.
            self._settled = changed_ns == self._changed_ns and abs(now_ns - changed_ns) > _SETTLE_NS
            self._changed_ns = changed_ns
            names = set(os.listdir(self._folder))  # noqa: PTH208 - names suffice, and this is done often
            self._seen &= names
            new = sorted(filter(_PICTURE_NAME.fullmatch, names - self._seen), key=_stamp_in)
            self._unfinished = {name: state for name, state in self._unfinished.items() if name in names}
            frames: list[Frame] = []
            for name in new:
                frames += self._take(name)
                if len(frames) == _AT_ONCE or sum(len(frame.picture) for frame in frames) > _MOST_BYTES:
                    self._settled = False  # the folder may contain more
                    break
        except OSError as error:
            raise CameraLostError(f"folder of pictures {self._folder} was lost: {error.strerror}") from error
        return frames

    def _take(self, name: str) -> list[Frame]:
        stamp_ns = self._clock.from_realtime(_stamp_in(name))
        if stamp_ns < self._since_ns:
            self._seen.add(name)
            return []
        data, refusal = b"", ""
        try:
            data = read_regular(self._folder / name, _MOST_BYTES, follow_links=False)
        except FileNotFoundError:  # removed since the scan
            return []
        except OSError as error:  # treated as an empty file, which may become readable
            refusal = f"{self._folder / name}: cannot be read ({error.strerror})"
        except CalibError as error:
            refusal = str(error)
        now_ns = self._clock.now_ns()
        if not is_complete(data):
            length, since_ns = self._unfinished.get(name, (-1, now_ns))
            if length != len(data):
                since_ns = now_ns
            self._unfinished[name] = (len(data), since_ns)
            if now_ns - since_ns < _UNFINISHED_LIMIT_NS:
                return []
        self._unfinished.pop(name, None)
        self._seen.add(name)
        self._sequence += 1
        source = StampSource.STAMP_SOURCE_FILE_NAME
        if stamp_ns > now_ns + _CLOCK_TOLERANCE_NS:  # named by another clock
            stamp_ns, source = now_ns, StampSource.STAMP_SOURCE_ARRIVAL
        return [Frame(data, stamp_ns, now_ns, source, self._sequence - 1, refusal)]


def _stamp_in(name: str) -> int:
    return int(name.partition(".")[0])
