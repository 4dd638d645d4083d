"""Grey pictures from files, folders and videos, one at a time, all of one size."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import MOST_PICTURE_BYTES, MOST_PIXELS, is_complete, read_regular, size_in_header

_PICTURES: Final = frozenset({".png", ".jpg", ".jpeg"})
_VIDEOS: Final = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".mjpeg", ".mjpg"})
_MOST_FRAMES: Final = 400  # of a video; searching them takes about a minute
_SMALLEST_PX: Final = 100  # markers cannot be decoded in smaller pictures

GreyPicture = NDArray[np.uint8]


def grey_pictures(paths: Sequence[Path]) -> Iterator[tuple[str, GreyPicture]]:
    """Yield names and pictures `[H, W]`.

    The pictures of a folder come in the order of their names. Of a long video, frames are taken at equal intervals.

    Raises:
        CalibError: a path does not exist, there is no picture, or one is broken, too small or of another size than the
            first.
    """
    first: tuple[str, tuple[int, ...]] | None = None
    for path in paths:
        for name, picture in _of(path):
            if min(picture.shape) < _SMALLEST_PX:
                raise CalibError(
                    f"{name}: has {_size(picture.shape)} pixels, at least {_SMALLEST_PX} each way are needed; "
                    "take the camera's whole picture"
                )
            if first is None:
                first = name, picture.shape
            if picture.shape != first[1]:
                raise CalibError(
                    f"{name}: has {_size(picture.shape)} pixels but {first[0]} has {_size(first[1])}; "
                    "give pictures of one camera at one size"
                )
            yield name, picture
    if first is None:
        raise CalibError(f"{paths[0]}: holds no PNG or JPEG picture; name pictures, a folder of them, or a video")


def _of(path: Path) -> Iterator[tuple[str, GreyPicture]]:
    if path.is_dir():
        for each in sorted(path.iterdir()):
            if each.suffix.lower() in _PICTURES and not each.name.startswith("."):
                yield each.name, _picture(each)
    elif not path.exists():
        raise CalibError(f"{path}: does not exist; check the path")
    elif path.suffix.lower() in _VIDEOS:
        yield from _frames(path)
    else:
        yield path.name, _picture(path)


def _picture(path: Path) -> GreyPicture:
    try:
        encoded = read_regular(path, MOST_PICTURE_BYTES)
    except OSError as error:
        raise CalibError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if not is_complete(encoded):
        raise CalibError(f"{path}: is truncated, or neither PNG nor JPEG; replace it or leave it out")
    width_px, height_px = size_in_header(encoded)
    if not 0 < width_px * height_px <= MOST_PIXELS:
        raise CalibError(f"{path}: claims {width_px}x{height_px} pixels, limit {MOST_PIXELS} in all; leave it out")
    # imdecode returns None for undecodable bytes; OpenCV's stubs do not declare that.
    picture = np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE))
    if picture.ndim != 2:
        raise CalibError(f"{path}: cannot be decoded; leave it out")
    return np.asarray(picture, dtype=np.uint8)


def _frames(path: Path) -> Iterator[tuple[str, GreyPicture]]:
    video = cv2.VideoCapture(str(path))
    try:
        every = max(1, round(video.get(cv2.CAP_PROP_FRAME_COUNT) / _MOST_FRAMES))
        number = -1
        while video.grab():
            number += 1
            if number % every:
                continue
            good, frame = video.retrieve()
            if good:
                grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                yield f"{path.name} frame {number}", np.asarray(grey, dtype=np.uint8)
        if number < 0:
            raise CalibError(f"{path}: is not a readable video; name pictures or a folder of them")
    finally:
        video.release()


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
