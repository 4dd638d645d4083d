"""What a log has lost, in words: readers fill it in, people read it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.onboard.errors import LogError

_PLACES_KEPT: Final = 100


class Damage(NamedTuple):
    """One place of a file that cannot be read."""

    path: Path
    offset: int
    n_bytes: int  # passed over; 0: nothing but the words about it
    reason: str

    def __str__(self) -> str:
        passed = f", {self.n_bytes} bytes passed over" if self.n_bytes else ""
        return f"{self.path.name}: at byte {self.offset}: {self.reason}{passed}"


@dataclass
class LogLosses:
    """What could not be read of a log.

    Attributes:
        places: the first of the damaged places.
        n_places: how many there are.
        n_torn: at how many of these bytes were passed over.
        n_bytes: passed over there.
        n_chunks: whole chunks that an index names and that were not found.
        n_undecodable: messages in good chunks that no schema of ours fits.
        unfinished: files that were never finished: all their whole chunks are read.
        unusable: files that hold nothing, by the reason.
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
        """Notes one place."""
        self.n_places += 1
        self.n_torn += damage.n_bytes > 0
        self.n_bytes += damage.n_bytes
        if len(self.places) < _PLACES_KEPT:
            self.places.append(damage)

    def add_undecodable(self, _path: Path, _reason: str) -> None:
        """Notes a message that fits nothing."""
        self.n_undecodable += 1

    def add_missing_end(self, path: Path, _offset: int) -> None:
        """Notes a file that ends without its end mark."""
        self.unfinished.append(path)

    def add_lost_chunks(self, _path: Path, n_chunks: int) -> None:
        """Notes how many chunks of its index a file does not hold."""
        self.n_chunks += max(0, n_chunks)

    def add_empty_file(self, path: Path) -> None:
        """Notes a file without a single whole chunk."""
        self.unusable[path] = "holds not one whole chunk"

    @property
    def n_lost(self) -> int:
        """How many things are lost, as far as they can be counted; a missing end or index as such is none."""
        return self.n_torn + self.n_chunks + self.n_undecodable

    @property
    def in_words(self) -> str:
        """What is lost, in a line; empty where nothing is."""
        counts = (
            (self.n_torn, f"damaged place of {self.n_bytes} bytes", f"damaged places of {self.n_bytes} bytes in all"),
            (self.n_chunks, "chunk that the index names", "chunks that the index names"),
            (self.n_undecodable, "message that cannot be decoded", "messages that cannot be decoded"),
            (len(self.unusable), "file that holds nothing", "files that hold nothing"),
        )
        return ", ".join(f"{n} {one if n == 1 else many}" for n, one, many in counts if n)

    def __bool__(self) -> bool:
        """Whether anything is amiss, an unfinished file included."""
        return bool(self.n_places or self.n_chunks or self.n_undecodable or self.unfinished or self.unusable)

    def lines(self, n_places: int = 5) -> list[str]:
        """For a person; with the first `n_places` places."""
        lines = [f"{path.name}: was never finished; read as far as it goes" for path in self.unfinished]
        lines += [f"{path.name}: not usable: {reason}" for path, reason in self.unusable.items()]
        lines += [str(place) for place in self.places[:n_places]]
        if self.n_places > n_places:
            lines.append(f"and {self.n_places - n_places} more damaged places, {self.n_bytes} bytes in all")
        if self.n_chunks:
            lines.append(f"{self.n_chunks} chunks that the index names are lost")
        if self.n_undecodable:
            lines.append(f"{self.n_undecodable} messages cannot be decoded")
        return lines


class NoLosses(LogLosses):
    """For readers that want all or nothing: every loss is an error."""

    def add(self, damage: Damage) -> None:
        """Raises LogError."""
        raise LogError(f"{damage.path}: damaged at byte {damage.offset}: {damage.reason}; salvage it first")

    def add_undecodable(self, path: Path, reason: str) -> None:
        """Raises LogError."""
        raise LogError(f"{path}: {reason}")

    def add_missing_end(self, path: Path, offset: int) -> None:
        """Raises LogError."""
        raise LogError(f"{path}: ends at byte {offset} before its end mark: cut short or never finished; salvage it")

    def add_lost_chunks(self, path: Path, n_chunks: int) -> None:
        """Raises LogError if there are any."""
        if n_chunks > 0:
            raise LogError(f"{path}: {n_chunks} chunks that its index names are lost; salvage it first")

    def add_empty_file(self, path: Path) -> None:
        """Raises LogError."""
        raise LogError(f"{path}: holds no /run, so it is not a groundsbot log; import it or choose another")
