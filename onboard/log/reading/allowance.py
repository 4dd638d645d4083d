"""Limits of memory and time for reading logs, beyond the shares that grow with the sizes of the files."""

from dataclasses import dataclass
from pathlib import Path

from groundsbot.onboard.errors import LogError


@dataclass
class Allowance:
    """Remaining allowance, shared by all logs of a command. Logs written by this project do not use any of it.

    Attributes:
        unfolded_bytes: size of uncompressed chunks.
        searched_bytes: size of false beginnings of chunks checked by a search.
        records: number of records in chunks; a hostile file may contain millions in a few kB.
        text_chars: length of robot.yaml texts in logs; parsing a million characters takes seconds.
    """

    unfolded_bytes: int = 1 << 20
    searched_bytes: int = 64 << 20
    records: int = 50_000
    text_chars: int = 1 << 18

    def check_text(self, text: str, log: Path, log_bytes: int) -> None:
        """Refuse a robot.yaml that is too long for the size of its log, and reduce the allowance.

        Raises:
            LogError: the text exceeds twice the size of the log plus the remaining allowance.
        """
        share = 2 * log_bytes
        if len(text) > share + self.text_chars:
            raise LogError(
                f"{log}: robot.yaml in /run has {len(text)} characters, limit {share + self.text_chars} for a log of "
                f"{log_bytes} bytes beside the others; read it alone"
            )
        self.text_chars -= max(0, len(text) - share)
