"""Printed pages as a scanner sees them, and where their lines lie."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pypdfium2
from numpy.typing import NDArray

from groundsbot.calib.foundation.arrays import FloatArray

_MM_PER_POINT = 25.4 / 72.0


class Scan(NamedTuple):
    """A page in grey, `[height, width]`, and how large its pixels are across and down: not quite as asked for, as
    their number is whole."""

    picture: NDArray[np.uint8]
    pixel_mm: FloatArray

    def place_mm(self, places_px: FloatArray) -> FloatArray:
        """Places `[..., 2]` with pixel centres at whole numbers, in mm from the paper's upper left corner."""
        return (places_px + 0.5) * self.pixel_mm

    def pixel(self, x_mm: float, y_mm: float) -> tuple[int, int]:
        """Row and column of the pixel at a place."""
        return int(y_mm / self.pixel_mm[1]), int(x_mm / self.pixel_mm[0])


def scan_page(pdf: Path, dpi: float, page: int = 0) -> Scan:
    """A page as a scanner sees it."""
    with _open_page(pdf) as document:
        picture = np.asarray(document[page].render(scale=dpi / 72.0, grayscale=True).to_numpy(), np.uint8).squeeze()
        size_mm = np.array(document[page].get_size()) * _MM_PER_POINT
    return Scan(picture, size_mm / picture.shape[::-1])


def n_pages(pdf: Path) -> int:
    with _open_page(pdf) as document:
        return len(document)


def words(pdf: Path, page: int = 0) -> str:
    """What a page says, one space between words."""
    with _open_page(pdf) as document:
        return " ".join(document[page].get_textpage().get_text_bounded().split())


def ruler_ticks_mm(scan: Scan) -> tuple[FloatArray, FloatArray]:
    """Where the ticks of the ruler at the left and of the one at the bottom lie along it."""
    dark = 255.0 - scan.picture.astype(np.float64)
    across_px, down_px = np.rint(0.7 / scan.pixel_mm).astype(int)  # from the ruler's edge into the shortest ticks
    left = int((dark[:, : dark.shape[1] // 8] > 64.0).sum(axis=0).argmax())
    lower = dark.shape[0] - 1 - int((dark[: -dark.shape[0] // 8 : -1] > 64.0).sum(axis=1).argmax())
    first = left - across_px // 2  # the other ruler's numbers lie before it
    return (
        _peaks(dark[:, left - across_px]) * scan.pixel_mm[1],
        _peaks(dark[lower + down_px, first:]) * scan.pixel_mm[0],
    )


def _peaks(line: FloatArray) -> FloatArray:
    """Middles of the dark places along a line of pixels."""
    inside = line > 32.0
    edges = np.flatnonzero(np.diff(inside, prepend=False, append=False)).reshape(-1, 2)
    middles = [np.average(np.arange(first, end) + 0.5, weights=line[first:end]) for first, end in edges]
    return np.array(middles)


@contextmanager
def _open_page(pdf: Path) -> Iterator[Any]:
    document = pypdfium2.PdfDocument(pdf)
    try:
        yield document
    finally:
        document.close()
