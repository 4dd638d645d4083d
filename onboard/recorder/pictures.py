"""Checks of pictures, and selection of the pictures to keep."""

from typing import Final

from groundsbot.calib.camera import CameraModel
from groundsbot.onboard.log import StampSource


class PictureChecks:
    """Checks of pictures that report each finding once."""

    def __init__(self, camera: CameraModel | None) -> None:
        """Set the camera whose size pictures must have; None accepts any size."""
        self._camera = camera
        self._odd_sizes: set[tuple[int, int]] = set()
        self._source: StampSource | int = StampSource.STAMP_SOURCE_UNSPECIFIED

    def odd_size(self, size_px: tuple[int, int]) -> str | None:
        """Return a text for a wrong size (width, height), or None if it is right or was reported before."""
        camera = self._camera
        if camera is None or size_px == (camera.width_px, camera.height_px) or size_px in self._odd_sizes:
            return None
        self._odd_sizes.add(size_px)
        return (
            f"pictures are {size_px[0]}x{size_px[1]} px, the calibration is for {camera.width_px}x{camera.height_px}: "
            "set the camera to that size or calibrate at this one"
        )

    def is_first_without_stamp(self, source: "StampSource | int") -> bool:
        """Return whether stamps change to the time of arrival with this picture."""
        before, self._source = self._source, source
        return source != before and source == StampSource.STAMP_SOURCE_ARRIVAL


_NS_PER_S: Final = 1_000_000_000
_JITTER: Final = 0.4  # a picture may be early by this share of the period between pictures to keep
_CATCH_UP_NS: Final = _NS_PER_S  # the schedule catches up with delays up to this


class PictureSchedule:
    """Schedule for keeping pictures at an average rate, or all if that is at least the camera's rate."""

    def __init__(self, rate_hz: float, camera_fps: float) -> None:
        """Start with the first picture.

        Args:
            rate_hz: rate of pictures to keep; 0 for none.
            camera_fps: rate of all pictures.
        """
        self._rate_hz = rate_hz
        self._keep_all = rate_hz >= camera_fps
        self._next_ns = 0

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether to keep the picture with this stamp. Call it once per picture, in order."""
        if self._keep_all or self._rate_hz <= 0:
            return self._keep_all
        period_ns = round(_NS_PER_S / self._rate_hz)
        late_ns = stamp_ns - self._next_ns
        if late_ns < -_JITTER * period_ns:
            return False
        in_step = late_ns <= max(period_ns, _CATCH_UP_NS)
        self._next_ns = (self._next_ns if in_step else stamp_ns) + period_ns
        return True
