"""How long a disk lasts: what is free over how fast the files grow, or will grow with what the devices give."""

from typing import Final, NamedTuple

_S_PER_H: Final = 3600.0
# Compressed, six tags in each picture, as measured from 20 to 1000 lines a second (test_disk_hours.py).
_BYTES_A_LINE: Final = 34.0
_BYTES_A_DETECTED_PICTURE: Final = 510.0
_BYTES_A_SECOND: Final = 2000.0  # heads and indexes of the chunks, one for each time that the disk is waited for


class Load(NamedTuple):
    """What the devices give."""

    lines_hz: float
    pictures_hz: float  # each looked at for tags
    kept_hz: float  # of them kept, at most
    picture_bytes: float  # of a kept one

    @property
    def kept_pictures_hz(self) -> float:
        """Pictures that will be kept: no more than there are."""
        return min(self.kept_hz, self.pictures_hz)

    @property
    def bytes_per_s(self) -> float:
        """How fast the files of a recording will grow."""
        measurements = _BYTES_A_LINE * self.lines_hz + _BYTES_A_DETECTED_PICTURE * self.pictures_hz
        return _BYTES_A_SECOND + measurements + self.picture_bytes * self.kept_pictures_hz


def hours_until_full(free_bytes: int, bytes_per_s: float | None) -> float | None:
    """How long there is room if the files grow like that; None where they do not grow or nobody knows."""
    return free_bytes / bytes_per_s / _S_PER_H if bytes_per_s else None
