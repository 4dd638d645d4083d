"""Objects with their large arrays apart are the same after it, array by array."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.foundation.parcel import digest_of, pack, unpack

LARGE = np.arange(600.0).reshape(20, 30)


@dataclass(frozen=True)
class Pair:
    a: FloatArray
    b: FloatArray


def test_an_object_is_as_before_with_the_arrays_given() -> None:
    packed = pack([Pair(LARGE, LARGE), Pair(LARGE.copy(), np.arange(3.0)), "text"])
    assert len(packed.arrays) == 2  # what is one object stays one, what is two stays two
    assert packed.arrays[0] is LARGE
    assert len(packed.content) < 500
    first, second, text = unpack(packed.content, packed.arrays)
    assert first.a is first.b is LARGE
    assert second.a is packed.arrays[1]
    np.testing.assert_array_equal(second.b, np.arange(3.0))
    assert text == "text"


@pytest.mark.parametrize(
    "array",
    [LARGE[:, ::2], np.array([{"a": 1}] * 500), np.ma.masked_array(LARGE, LARGE > 3.0)],
    ids=["with gaps", "of objects", "of a subclass"],
)
def test_arrays_of_other_kinds_stay_in_the_bytes(array: Any) -> None:
    packed = pack(array)
    assert packed.arrays == []
    np.testing.assert_array_equal(unpack(packed.content, []), array)


def test_a_digest_is_of_elements_type_shape_and_order() -> None:
    others = [
        LARGE.reshape(30, 20),
        LARGE.view(np.int64),
        np.asfortranarray(LARGE),
        LARGE + 1e-12,
        LARGE.astype(">f8"),
    ]
    assert len({digest_of(each) for each in (LARGE, *others)}) == 6
    assert digest_of(LARGE.copy()) == digest_of(LARGE)
    stamps = LARGE.astype("datetime64[ns]")
    assert digest_of(stamps) == digest_of(stamps.copy())
