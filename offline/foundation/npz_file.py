"""Arrays from a .npz file that may be damaged or somebody's: none is larger than what it takes up there."""

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
    """The arrays by their names, each read when it is asked for.

    Raises:
        OSError: the file cannot be read.
        BadZipFile, ValueError: it is no such file, or unfolds to more than it holds.
    """
    with zipfile.ZipFile(path) as file:
        n_bytes = sum(each.file_size for each in file.infolist())
        if n_bytes > path.stat().st_size:  # numpy stores arrays as they are
            raise ValueError(f"{path.name} unfolds to {n_bytes} bytes")
        yield _Arrays(file)


class _Arrays(Mapping[str, Any]):
    def __init__(self, file: zipfile.ZipFile) -> None:
        self._file = file
        self._sizes = {each.filename.removesuffix(".npy"): each.file_size for each in file.infolist()}

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 - an array of any type
        """Checks first what the head claims: room would be made for it, and texts of no length take none in the file.

        Raises:
            KeyError: there is none.
            ValueError: it is damaged.
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
