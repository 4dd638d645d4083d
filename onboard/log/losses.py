"""Losses found while reading a log, and their description."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.onboard.errors import LogError

_PLACES_KEPT: Final = 100


class Damage(NamedTuple):
    """A part of a file that cannot be read."""

    path: Path
    offset: int
    n_bytes: int  # skipped; 0 for damage without a loss of bytes
    reason: str

    def __str__(self) -> str:
        skipped = f", {self.n_bytes} bytes skipped" if self.n_bytes else ""
        return f"{self.path.name}: at byte {self.offset}: {self.reason}{skipped}"


@dataclass
class LogLosses:
    """Losses of a log.

    Attributes:
        places: the first damaged places.
        n_places: number of damaged places.
        n_torn: number of damaged places at which bytes were skipped.
        n_bytes: number of bytes skipped.
        n_chunks: number of chunks that are in an index but were not found.
        n_undecodable: number of messages in intact chunks that do not fit their schema.
        unfinished: files that were never finished. All their intact chunks are read.
        unusable: files without any intact chunk, and the reason.
    """

    places: list[Damage] = field(default_factory=list)
    n_places: int = 0
    n_torn: int = 0
    n_bytes: int = 0
    n_chunks: int = 0
    n_undecodable: int = 0
    unfinished: list[Path] = field(default_factory=list)
    unusable: dict[Path, str] = field(default_factory=dict)

    def add(self, damage: Damage) -> None:
        """Add a damaged place."""
        self.n_places += 1
        self.n_torn += damage.n_bytes > 0
        self.n_bytes += damage.n_bytes
        if len(self.places) < _PLACES_KEPT:
            self.places.append(damage)

    def add_undecodable(self, _path: Path, _reason: str) -> None:
        """Count a message that cannot be decoded."""
        self.n_undecodable += 1

    def add_missing_end(self, path: Path, _offset: int) -> None:
        """Add a file without its end mark (MCAP's DataEnd record)."""
        self.unfinished.append(path)

    def add_lost_chunks(self, _path: Path, n_chunks: int) -> None:
        """Count chunks that are in the index of a file but not in the file."""
        self.n_chunks += max(0, n_chunks)

    def add_empty_file(self, path: Path) -> None:
        """Add a file without any intact chunk."""
        self.unusable[path] = "contains no intact chunk"

    @property
    def n_lost(self) -> int:
        """Number of damaged places, missing chunks and undecodable messages, without missing ends and indexes."""
        return self.n_torn + self.n_chunks + self.n_undecodable

    @property
    def in_words(self) -> str:
        """The losses in one line; empty without losses."""
        counts = (
            (self.n_torn, f"damaged place of {self.n_bytes} bytes", f"damaged places of {self.n_bytes} bytes in all"),
            (self.n_chunks, "missing chunk of the index", "missing chunks of the index"),
            (self.n_undecodable, "message that cannot be decoded", "messages that cannot be decoded"),
            (len(self.unusable), "file without data", "files without data"),
        )
        return ", ".join(f"{n} {one if n == 1 else many}" for n, one, many in counts if n)

    def __bool__(self) -> bool:
        """Return whether there is any loss or an unfinished file."""
        return bool(self.n_places or self.n_chunks or self.n_undecodable or self.unfinished or self.unusable)

    def lines(self, n_places: int = 5) -> list[str]:
        """Return a description with at most `n_places` damaged places."""
        lines = [f"{path.name}: was never finished; read up to its end" for path in self.unfinished]
        lines += [f"{path.name}: not usable: {reason}" for path, reason in self.unusable.items()]
        lines += [str(place) for place in self.places[:n_places]]
        if self.n_places > n_places:
            lines.append(f"and {self.n_places - n_places} more damaged places, {self.n_bytes} bytes in all")
        if self.n_chunks:
            lines.append(f"{self.n_chunks} chunks of the index are missing")
        if self.n_undecodable:
            lines.append(f"{self.n_undecodable} messages cannot be decoded")
        return lines


class NoLosses(LogLosses):
    """Losses for strict reading: every loss raises an error."""

    def add(self, damage: Damage) -> None:
        """Raise LogError."""
        raise LogError(f"{damage.path}: damaged at byte {damage.offset}: {damage.reason}; salvage it first")

    def add_undecodable(self, path: Path, reason: str) -> None:
        """Raise LogError."""
        raise LogError(f"{path}: {reason}")

    def add_missing_end(self, path: Path, offset: int) -> None:
        """Raise LogError."""
        raise LogError(f"{path}: ends at byte {offset} before its end mark: cut short or never finished; salvage it")

    def add_lost_chunks(self, path: Path, n_chunks: int) -> None:
        """Raise LogError if chunks are missing."""
        if n_chunks > 0:
            raise LogError(f"{path}: {n_chunks} chunks of its index are missing; salvage it first")

    def add_empty_file(self, path: Path) -> None:
        """Raise LogError."""
        raise LogError(f"{path}: holds no /run, so it is not a groundsbot log; import it or choose another")
