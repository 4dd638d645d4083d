"""The frame numbers of a V4L2 driver, which count the frames that it dropped. OpenCV does not pass them on."""

import fcntl
import os
import stat
import struct
from contextlib import suppress
from pathlib import Path
from typing import Final

# struct v4l2_buffer of linux/videodev2.h: index, type, bytesused, flags, field, timestamp (2), timecode (7), sequence,
# memory, m, length, reserved2, request_fd; padded to its alignment.
_BUFFER: Final = struct.Struct("@5I2l2I4B4s2IL3I0L")
_FLAGS_AT, _SEQUENCE_AT = 3, 14
_QUERYBUF: Final = 3 << 30 | _BUFFER.size << 16 | ord("V") << 8 | 9  # VIDIOC_QUERYBUF
_VIDEO_CAPTURE: Final = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
_MMAP: Final = 1  # V4L2_MEMORY_MMAP
_WITH_DRIVER: Final = 0x2 | 0x4  # V4L2_BUF_FLAG_QUEUED, V4L2_BUF_FLAG_DONE
_MOST_BUFFERS: Final = 32  # VIDEO_MAX_FRAME
_COUNT_LIMIT: Final = 1 << 32
_LARGEST_GAP: Final = 10_000  # a larger step of the driver's number is a new count


class DriverSequence:
    """Numbers of the frames of an open camera, from the driver if it has them.

    A driver answers for the process that streams only, so the question goes through OpenCV's own file descriptor.
    """

    def __init__(self, device: str, first: int) -> None:
        """Find the descriptor by which the device is open.

        Args:
            device: name of the device, or a link to it.
            first: number of the first frame.
        """
        self._next = first
        self._descriptor = _descriptor_of(device)
        self._driver: int | None = None  # number that the driver gave to the last frame

    def take(self) -> int:
        """Return the number of the frame that is grabbed and not retrieved yet; a gap means lost frames."""
        before, self._driver = self._driver, self._ask()
        if before is not None and self._driver is not None:
            n_lost = (self._driver - before) % _COUNT_LIMIT - 1
            if 0 < n_lost < _LARGEST_GAP:
                self._next += n_lost
        self._next += 1
        return self._next - 1

    def _ask(self) -> int | None:
        """Return the driver's number of the only buffer that is not with the driver."""
        if self._descriptor is None:
            return None
        with suppress(OSError):  # there are no more buffers, or the driver does not answer
            for index in range(_MOST_BUFFERS):
                found = _query(self._descriptor, index)
                if not found[_FLAGS_AT] & _WITH_DRIVER:
                    return int(found[_SEQUENCE_AT])
        return None


def _query(descriptor: int, index: int) -> tuple[int, ...]:
    request = _BUFFER.pack(index, _VIDEO_CAPTURE, *[0] * 11, b"", 0, _MMAP, *[0] * 4)
    return _BUFFER.unpack(fcntl.ioctl(descriptor, _QUERYBUF, request))


def _descriptor_of(device: str) -> int | None:
    with suppress(OSError):
        wanted = Path(device).stat()
        if not stat.S_ISCHR(wanted.st_mode):
            return None
        for name in sorted(os.listdir("/proc/self/fd"), key=int, reverse=True):  # noqa: PTH208 - names suffice
            with suppress(OSError):  # closed by another thread meanwhile
                found = os.fstat(int(name))
                if stat.S_ISCHR(found.st_mode) and found.st_rdev == wanted.st_rdev:
                    return int(name)
    return None
