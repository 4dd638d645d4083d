"""Pictures as bytes: their size is known, and bounded, before anything is decoded."""

import cv2
import numpy as np
import pytest

from groundsbot.calib.foundation.picture_bytes import size_in_header
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log.picture import decode, decode_grey


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_the_size_is_read_from_the_head(suffix: str, shape: tuple[int, ...]) -> None:
    encoded = cv2.imencode(suffix, np.zeros(shape, np.uint8))[1].tobytes()
    assert size_in_header(encoded) == (64, 48)
    assert decode(encoded).shape[:2] == decode_grey(encoded).shape == (48, 64)
    for end in range(len(encoded)):
        assert size_in_header(encoded[:end]) in ((64, 48), (0, 0), (64, 0), (0, 48))


def test_a_picture_that_would_fill_the_memory_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    jpeg = bytearray(cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes())
    at = jpeg.index(b"\xff\xc0") + 5
    jpeg[at : at + 4] = b"\xff\xff\xff\xff"
    png = cv2.imencode(".png", np.zeros((4100, 4100), np.uint8))[1].tobytes()
    monkeypatch.setattr(cv2, "imdecode", None)
    for encoded, size in ((bytes(jpeg), "65535x65535"), (png, "4100x4100")):
        with pytest.raises(OnboardError, match=f"claims {size} pixels, limit 16777216"):
            decode_grey(encoded)
