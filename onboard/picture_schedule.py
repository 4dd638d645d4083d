"""Which pictures to keep, where not all are kept."""

from typing import Final

_NS_PER_S: Final = 1_000_000_000
_JITTER: Final = 0.4  # of the period between pictures to keep: how early one may be
_CATCH_UP_NS: Final = _NS_PER_S  # pictures that were held up so long are made up for


class PictureSchedule:
    """Keeps pictures at an average rate, or all where that is the camera's own rate or more."""

    def __init__(self, rate_hz: float, camera_fps: float) -> None:
        """Begins with the first picture.

        Args:
            rate_hz: of pictures to keep; 0 for none.
            camera_fps: of all pictures.
        """
        self._rate_hz = rate_hz
        self._keep_all = rate_hz >= camera_fps
        self._next_ns = 0

    def is_due(self, stamp_ns: int) -> bool:
        """Whether the picture of this stamp is one to keep. Ask once a picture, in their order."""
        if self._keep_all or self._rate_hz <= 0:
            return self._keep_all
        period_ns = round(_NS_PER_S / self._rate_hz)
        late_ns = stamp_ns - self._next_ns
        if late_ns < -_JITTER * period_ns:
            return False
        in_step = late_ns <= max(period_ns, _CATCH_UP_NS)
        self._next_ns = (self._next_ns if in_step else stamp_ns) + period_ns
        return True
