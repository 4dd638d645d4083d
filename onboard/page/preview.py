"""The camera's picture for the page: small, with the tags found in it, and with warnings about light and blur."""

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board import Coverage, SeenBoard
from groundsbot.calib.foundation import FloatArray, size_in_header
from groundsbot.onboard.detection import Detection, draw_board, draw_tags
from groundsbot.onboard.log import Picture, decode, decode_smaller, encode_jpeg, to_grey

FRESH_S: Final = 2.0  # an older picture is not what the camera sees
_IN_A_ROW: Final = 2
_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_WIDTH_PX: Final = 640
_QUALITY: Final = 70
# Measured (docs/robot_page.md): tags whose white has 20 grey levels are found as well as others, with 12 hardly, with 7
# not at all. A tag is found from a side of 22 px on, and of 18 times the blur's sigma if that is more.
_DARK_GREY: Final = 25.0
_BRIGHT_SHARE: Final = 0.05  # of the picture, which is as bright as the white of tags
_BLUR_PX: Final = 2.0
_SIDES_PER_BLUR: Final = 18.0
_WHITE_GREY: Final = 250
_WHITE_SHARE: Final = 0.5
_MODULES: Final = 8.0  # of black border and code along a side
_ALONG: Final = np.linspace(0.3, 0.7, 9)  # places on a side at which its profile is taken
_STEP_PX: Final = 0.25


class Preview(NamedTuple):
    """A picture for the page."""

    jpeg: bytes
    warnings: tuple[str, ...]
    blur_px: float | None  # sigma of the blur of the tags' sides, in pixels of the camera's picture; None without tags


def make_preview(picture: Picture, detections: Sequence[Detection], side_px_m: float | None) -> Preview:
    """Return a picture of at most 640 px in width, with outlines and ids of the tags.

    Args:
        picture: the picture.
        detections: the tags found in it.
        side_px_m: focal length times side of the robot's tags, which is their distance times their side in the picture;
            None if it is not known.

    Raises:
        OnboardError: the picture cannot be decoded.
    """
    if isinstance(picture, bytes):
        full_px = size_in_header(picture)[0]
        seen = decode_smaller(picture, _WIDTH_PX)
    else:
        full_px = picture.shape[1]
        seen = np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture, np.uint8)
    scale = min(1.0, _WIDTH_PX / seen.shape[1])
    size = (max(1, round(seen.shape[1] * scale)), max(1, round(seen.shape[0] * scale)))
    drawn = np.array(seen if scale == 1.0 else cv2.resize(seen, size, interpolation=cv2.INTER_AREA), np.uint8)
    shrink = size[0] / full_px
    # Pixel centres lie at whole numbers in both pictures.
    tags = [(each.tag_id, (each.corners_px + 0.5) * shrink - 0.5) for each in detections]
    grey = to_grey(drawn)
    blurs = [edge_sigma_px(grey, corners) / shrink for _, corners in tags]
    blur_px = float(np.median(blurs)) if blurs else None
    words = tuple(_warnings(grey, blur_px, side_px_m))
    draw_tags(drawn, tags)
    return Preview(encode_jpeg(drawn, _QUALITY), words, blur_px)


class SideBySide:
    """The newest pictures of all cameras, side by side, two in a row; those of a single camera unchanged."""

    def __init__(self, cameras: Sequence[str]) -> None:
        self._newest: dict[str, tuple[Preview, float] | None] = dict.fromkeys(cameras)
        self._is_new = False

    def add(self, camera: str, preview: Preview) -> None:
        """Add a picture of a camera."""
        self._newest[camera] = preview, time.monotonic()
        self._is_new = True

    def take(self) -> Preview | None:
        """Return the pictures as one; None if there is none since the last call. A camera that gives none is black."""
        if not self._is_new:
            return None
        self._is_new = False
        newest_s = max(found[1] for found in self._newest.values() if found is not None)
        fresh = {
            name: found[0] if found is not None and newest_s - found[1] < FRESH_S else None
            for name, found in self._newest.items()
        }
        (first, *others) = fresh.items()
        return first[1] if not others else join_previews(fresh)


def join_previews(previews: Mapping[str, Preview | None]) -> Preview:
    """Return the pictures of several cameras by name as one, two in a row; a camera without one is black."""
    pictures = {name: decode(each.jpeg) for name, each in previews.items() if each is not None}
    height = max(each.shape[0] for each in pictures.values())
    width = max(each.shape[1] for each in pictures.values())
    rows = -(-len(previews) // _IN_A_ROW)
    joined = np.zeros((rows * height, _IN_A_ROW * width, 3), np.uint8)
    for index, name in enumerate(previews):
        top, left = index // _IN_A_ROW * height, index % _IN_A_ROW * width
        if name in pictures:
            seen = pictures[name]
            joined[top : top + seen.shape[0], left : left + seen.shape[1]] = seen
        text = name if name in pictures else f"{name}: no picture"
        for colour, thickness in ((_BLACK, 4), (_WHITE, 1)):
            cv2.putText(joined, text, (left + 8, top + 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, thickness)
    found = {name: each for name, each in previews.items() if each is not None}
    warnings = tuple(f"{name}: {text}" for name, each in found.items() for text in each.warnings)
    blurs = [each.blur_px for each in found.values() if each.blur_px is not None]
    return Preview(encode_jpeg(joined, _QUALITY), warnings, max(blurs, default=None))


def make_board_preview(picture: Picture, seen: SeenBoard | None, spread: Coverage) -> Preview:
    """Return a picture of at most 640 px in width, with the corners of the board and the regions not covered yet.

    Raises:
        OnboardError: the picture cannot be decoded.
    """
    drawn = draw_board(picture, seen, spread)
    scale = min(1.0, _WIDTH_PX / drawn.shape[1])
    small = cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return Preview(encode_jpeg(np.asarray(small, np.uint8), _QUALITY), (), None)


def _warnings(grey: NDArray[np.uint8], blur_px: float | None, side_px_m: float | None) -> Iterator[str]:
    bright = float(np.quantile(grey, 1.0 - _BRIGHT_SHARE))
    if bright < _DARK_GREY:
        yield f"too dark (bright parts have grey {bright:.0f} of 255): tags will be missed; more light or exposure"
    white = float((grey >= _WHITE_GREY).mean())
    if white > _WHITE_SHARE:
        yield f"too bright ({100.0 * white:.0f} % of the picture is white): edges of tags shift; less exposure"
    if blur_px is not None and blur_px > _BLUR_PX:
        side_px = _SIDES_PER_BLUR * blur_px
        which = f"with sides below {side_px:.0f} px" if side_px_m is None else f"beyond {side_px_m / side_px:.1f} m"
        yield (
            f"blurred (edges of tags by {blur_px:.1f} px): tags {which} will be missed; "
            "drive slower, shorter exposure, or focus"
        )


def edge_sigma_px(grey: NDArray[np.uint8], corners_px: FloatArray) -> float:
    """Return the sigma of the blur of a tag's sides, of the side that is blurred most.

    It is the contrast over the steepest slope across the side, over the square root of 2 pi, as of a step that a
    Gaussian blurred; a blur by motion in one direction shows on the sides across it.

    Args:
        grey: the picture [height, width].
        corners_px: the tag's corners [4, 2] in it.
    """
    sigmas = []
    for first, second in zip(corners_px, np.roll(corners_px, -1, axis=0), strict=True):
        side = second - first
        length = max(float(np.hypot(*side)), 1.0)
        across = np.array([side[1], -side[0]]) / length
        half = length / _MODULES
        offsets = np.arange(-half, half + _STEP_PX, _STEP_PX)
        places = first + _ALONG[:, None, None] * side + offsets[None, :, None] * across
        x, y = places.astype(np.float32).transpose(2, 0, 1)
        profile = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
        mean = profile.mean(axis=0)
        slope = np.abs(np.gradient(mean, _STEP_PX)).max()
        sigmas.append(float(np.ptp(mean) / max(slope, 1e-6) / np.sqrt(2.0 * np.pi)))
    return max(sigmas)
