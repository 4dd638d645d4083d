"""The logs that one command reads together: what each may take beyond its size's worth is one share of one allowance.

A log gets some time and memory whatever its size, since a drive may be short. Were that so for each of a thousand
small files, a folder of them would take minutes and gigabytes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.offline.errors import OfflineError

# Any number of drives may be mapped together, as long as they were driven: recorded ones take 200 kB a minute and more,
# and who has a hundred has some that broke off. Pairs of segments are laid over each other.
_FREE_SEGMENTS: Final = 25
_BYTES_A_SEGMENT: Final = 64 << 10


class Inputs(NamedTuple):
    """How many logs there are, and their size together; one alone unless said otherwise."""

    n_logs: int = 1
    n_bytes: int = 0

    @staticmethod
    def of(logs: Sequence[Path]) -> "Inputs":
        """Files and run folders; one that is not there has no size, and reading it says so."""
        return Inputs(max(1, len(logs)), sum(map(size_bytes, logs)))

    @property
    def most_segments(self) -> int:
        """How many segments all of them may have."""
        return _FREE_SEGMENTS + self.n_bytes // _BYTES_A_SEGMENT

    def check_segments(self, n_segments: int, log: Path) -> None:
        """Refuses more segments of drives than logs of this size are worth.

        Args:
            n_segments: of the logs up to this one, at least.
            log: named in the error.

        Raises:
            OfflineError: naming how many there are, the limit and the way out.
        """
        if self.n_logs > 1 and n_segments > self.most_segments:
            raise OfflineError(
                f"{log}: with it there are {n_segments} drives or segments of such in {self.n_logs} logs, limit "
                f"{self.most_segments} for {self.n_bytes} bytes in all; map some of them and add the others by "
                "--extend, or leave some out"
            )


ALONE: Final = Inputs()


def size_bytes(log: Path) -> int:
    """Of all files of a log; of none where there is no such log."""
    files = log.iterdir() if log.is_dir() else [log]
    return sum(path.stat().st_size for path in files if path.is_file())
