"""Reads arrays from a .npz file that may be damaged or untrusted; no array may be larger than its data in the file."""

import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

_HEADS: Final[dict[tuple[int, int], Callable[[IO[bytes]], tuple[tuple[int, ...], bool, "np.dtype[Any]"]]]] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


@contextmanager
def open_arrays(path: Path) -> Iterator[Mapping[str, Any]]:
    """Yield the arrays by name; each is read on access.

    Raises:
        OSError: the file cannot be read.
        BadZipFile, ValueError: it is not a .npz file, or its members expand to more than its size.
    """
    with zipfile.ZipFile(path) as file:
        n_bytes = sum(each.file_size for each in file.infolist())
        if n_bytes > path.stat().st_size:  # numpy.savez does not compress
            raise ValueError(f"{path.name} expands to {n_bytes} bytes, more than the file has")
        yield _Arrays(file)


class _Arrays(Mapping[str, Any]):
    """The arrays of an open .npz file by name."""

    def __init__(self, file: zipfile.ZipFile) -> None:
        self._file = file
        self._sizes = {each.filename.removesuffix(".npy"): each.file_size for each in file.infolist()}

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 - an array of any type
        """Read an array after checking the size in its header, for which numpy would allocate memory.

        The size is counted with at least one byte an item, because strings of length zero take no space in the file.

        Raises:
            KeyError: there is no array of this name.
            ValueError: the array is damaged.
        """
        size = self._sizes[name]
        with self._file.open(f"{name}.npy") as member:
            version = np.lib.format.read_magic(member)
            if version not in _HEADS:
                raise ValueError(f"{name} is of version {version}")
            shape, _, kind = _HEADS[version](member)
            if prod(shape) * max(kind.itemsize, 1) > size:
                raise ValueError(f"{name} claims the shape {shape} in {size} bytes")
        with self._file.open(f"{name}.npy") as member:
            return np.lib.format.read_array(member, allow_pickle=False)

    def __contains__(self, name: object) -> bool:
        return name in self._sizes

    def __iter__(self) -> Iterator[str]:
        return iter(self._sizes)

    def __len__(self) -> int:
        return len(self._sizes)
