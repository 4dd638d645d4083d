"""Time until a disk is full, from its free space and the measured or expected growth of the files."""

from typing import Final, NamedTuple

_S_PER_H: Final = 3600.0
# Compressed, with six tags per picture, measured from 20 to 1000 lines or samples per second (test_disk_hours.py).
_BYTES_A_LINE: Final = 34.0
_BYTES_A_SAMPLE: Final = 40.0  # of a gyro
_BYTES_A_DETECTED_PICTURE: Final = 510.0
_BYTES_A_SECOND: Final = 2000.0  # heads and indexes of chunks, one per sync


class Load(NamedTuple):
    """Data rates of the devices."""

    lines_hz: float
    pictures_hz: float  # pictures in which tags are detected
    kept_hz: float  # largest rate of pictures kept
    picture_bytes: float  # size of a picture kept
    samples_hz: float = 0.0  # of a gyro

    @property
    def kept_pictures_hz(self) -> float:
        """Rate of pictures kept, limited by the rate of pictures."""
        return min(self.kept_hz, self.pictures_hz)

    @property
    def bytes_per_s(self) -> float:
        """Expected growth of the files of a recording."""
        measurements = _BYTES_A_LINE * self.lines_hz + _BYTES_A_DETECTED_PICTURE * self.pictures_hz
        measurements += _BYTES_A_SAMPLE * self.samples_hz
        return _BYTES_A_SECOND + measurements + self.picture_bytes * self.kept_pictures_hz


def hours_until_full(free_bytes: int, bytes_per_s: float | None) -> float | None:
    """Return the hours until the disk is full, or None if the growth is zero or unknown."""
    return free_bytes / bytes_per_s / _S_PER_H if bytes_per_s else None
