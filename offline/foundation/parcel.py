"""Objects as bytes with their large arrays apart, so that an array need not be sent where it is already."""

import hashlib
import io
import pickle
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

_Array = np.ndarray[Any, Any]

# Smaller arrays stay in the bytes. A digest with its place takes about 100 bytes.
_LEAST_BYTES: Final = 1 << 10
_PROTOCOL: Final = 4  # as between the processes of `Workers`: arrays arrive writable, whatever they were
_DIGEST_BYTES: Final = 16


class Packed(NamedTuple):
    """An object whose large arrays are apart.

    Attributes:
        content: the rest, with a number in the place of each array.
        arrays: arrays by this number; those of the object itself, not copies.
    """

    content: bytes
    arrays: list[_Array]

    def digests(self) -> list[bytes]:
        """Return the digest of each array."""
        return [digest_of(array) for array in self.arrays]


def pack(value: object) -> Packed:
    """Return an object as bytes and large arrays."""
    file = io.BytesIO()
    packer = _Packer(file)
    packer.dump(value)
    return Packed(file.getvalue(), packer.arrays)


def unpack(content: bytes, arrays: Sequence[_Array]) -> Any:  # noqa: ANN401 (whatever was packed)
    """Return the object of `Packed.content` with these arrays, which become part of it."""
    return _Unpacker(io.BytesIO(content), arrays).load()


def digest_of(array: _Array) -> bytes:
    """Return a digest of type, shape, order and elements of an array that is contiguous in C's or Fortran's order."""
    head = (str(array.dtype), array.shape, array.flags.c_contiguous)
    digest = hashlib.blake2b(repr(head).encode(), digest_size=_DIGEST_BYTES)
    digest.update(array.ravel(order="K").view(np.uint8).data)
    return digest.digest()


class _Packer(pickle.Pickler):
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, _PROTOCOL)
        self.arrays: list[_Array] = []
        self._numbers: dict[int, int] = {}  # by identity, so that what is one object stays one

    def persistent_id(self, item: object) -> int | None:
        """Return the number of a large array; None for anything else, which goes into the bytes."""
        if type(item) is not np.ndarray or item.nbytes < _LEAST_BYTES:
            return None
        if item.dtype.hasobject or not item.flags.forc:
            return None
        if id(item) not in self._numbers:
            self._numbers[id(item)] = len(self.arrays)
            self.arrays.append(item)
        return self._numbers[id(item)]


class _Unpacker(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, arrays: Sequence[_Array]) -> None:
        super().__init__(file)
        self._arrays = arrays

    def persistent_load(self, number: int) -> _Array:
        """Return the array of a number."""
        return self._arrays[number]
