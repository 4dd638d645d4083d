"""Which pictures to keep, where not all are kept."""

from typing import Final

from groundsbot.calib.camera import CameraModel
from groundsbot.onboard.log import StampSource


class PictureChecks:
    """Remembers what was told of already."""

    def __init__(self, camera: CameraModel | None) -> None:
        """Args: camera: whose calibration pictures must fit; None: any size will do."""
        self._camera = camera
        self._odd_sizes: set[tuple[int, int]] = set()
        self._source: StampSource | int = StampSource.STAMP_SOURCE_UNSPECIFIED

    def odd_size(self, size_px: tuple[int, int]) -> str | None:
        """What is wrong with a size (width, height); None: nothing, or it was told of before."""
        camera = self._camera
        if camera is None or size_px == (camera.width_px, camera.height_px) or size_px in self._odd_sizes:
            return None
        self._odd_sizes.add(size_px)
        return (
            f"pictures are {size_px[0]}x{size_px[1]} px, the calibration is for {camera.width_px}x{camera.height_px}: "
            "set the camera to that size or calibrate at this one"
        )

    def is_first_without_stamp(self, source: "StampSource | int") -> bool:
        """Whether this picture is the first of those that their arrival has to date."""
        before, self._source = self._source, source
        return source != before and source == StampSource.STAMP_SOURCE_ARRIVAL


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
