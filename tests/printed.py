"""Printed pages as a scanner sees them, and where their lines lie."""

from pathlib import Path

import numpy as np
import pypdfium2
from numpy.typing import NDArray

MM_PER_INCH = 25.4


def scanned(pdf: Path, dpi: float, page: int = 0) -> NDArray[np.uint8]:
    """A page in grey, `[height, width]`."""
    document = pypdfium2.PdfDocument(pdf)
    try:
        return np.asarray(document[page].render(scale=dpi / 72.0, grayscale=True).to_numpy(), np.uint8).squeeze()
    finally:
        document.close()


def n_pages(pdf: Path) -> int:
    document = pypdfium2.PdfDocument(pdf)
    try:
        return len(document)
    finally:
        document.close()


def words(pdf: Path, page: int = 0) -> str:
    """What a page says."""
    document = pypdfium2.PdfDocument(pdf)
    try:
        return str(document[page].get_textpage().get_text_bounded())
    finally:
        document.close()
