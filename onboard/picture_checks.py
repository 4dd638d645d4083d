"""What is checked of each picture beside its tags: its size, and where its stamp comes from."""

from groundsbot.calib.camera_model import CameraModel
from groundsbot.onboard.messages import StampSource


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

    def lost_its_stamps(self, source: "StampSource | int") -> bool:
        """Whether this picture is the first of those that their arrival has to date."""
        before, self._source = self._source, source
        return source != before and source == StampSource.STAMP_SOURCE_ARRIVAL
