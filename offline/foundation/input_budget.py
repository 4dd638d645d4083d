"""Limits for the logs that one command reads together.

The limits of a log grow with its size, from a constant, because a drive may be short. The logs of one command share
this constant, since for each of a thousand small files it would allow minutes and gigabytes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.offline.errors import OfflineError

# Any number of recorded drives stays within the limit: they take 200 kB a minute or more, and of a hundred only a few
# ended early. The time for alignment grows with the number of pairs of segments.
_FREE_SEGMENTS: Final = 25
_BYTES_A_SEGMENT: Final = 64 << 10


class Inputs(NamedTuple):
    """The number of logs that are read together, and their total size."""

    n_logs: int = 1
    n_bytes: int = 0

    @staticmethod
    def of(logs: Sequence[Path]) -> "Inputs":
        """Return the number and total size of files and run folders; missing ones, refused later, have size zero."""
        return Inputs(max(1, len(logs)), sum(map(size_bytes, logs)))

    @property
    def most_segments(self) -> int:
        """Limit on the segments of all logs together."""
        return _FREE_SEGMENTS + self.n_bytes // _BYTES_A_SEGMENT

    def check_segments(self, n_segments: int, log: Path) -> None:
        """Raise an error if the logs of one command contain more segments than their total size allows.

        A segment is a part of a drive with unbroken odometry. A single log has no limit.

        Args:
            n_segments: number of segments in the logs read so far, `log` included, or a lower bound of it.
            log: the log that was read last, for the message.

        Raises:
            OfflineError: there are more segments than `most_segments`.
        """
        if self.n_logs > 1 and n_segments > self.most_segments:
            raise OfflineError(
                f"{log}: the logs up to this one have {n_segments} segments of drives, limit {self.most_segments} for "
                f"{self.n_logs} logs of {self.n_bytes} bytes in total; map some of them and add the others by "
                "--extend, or leave some out"
            )


ALONE: Final = Inputs()


def size_bytes(log: Path) -> int:
    """Return the total size of a log's files; zero where there is no such log."""
    files = log.iterdir() if log.is_dir() else [log]
    return sum(path.stat().st_size for path in files if path.is_file())
