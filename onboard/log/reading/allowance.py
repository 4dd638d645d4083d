"""What reading logs may take beyond what their sizes are worth: all logs of a command share one."""

from dataclasses import dataclass
from pathlib import Path

from groundsbot.onboard.errors import LogError


@dataclass
class Allowance:
    """What is left. Logs of ours take nothing of it, be they many or few.

    Attributes:
        unfolded_bytes: of compressed chunks.
        searched_bytes: of false beginnings of chunks that a search may check.
        records: in chunks; a hostile file may hold millions in a few kB.
        text_chars: of robot.yamls in logs; to parse a million takes seconds.
    """

    unfolded_bytes: int = 1 << 20
    searched_bytes: int = 64 << 20
    records: int = 50_000
    text_chars: int = 1 << 18

    def check_text(self, text: str, log: Path, log_bytes: int) -> None:
        """Refuses a log's robot.yaml that no log of its size holds, where others had such too.

        Raises:
            LogError: naming the log, the text's length and the limit.
        """
        worth = 2 * log_bytes
        if len(text) > worth + self.text_chars:
            raise LogError(
                f"{log}: robot.yaml in /run has {len(text)} characters, limit {worth + self.text_chars} for a log of "
                f"{log_bytes} bytes beside the others; read it alone"
            )
        self.text_chars -= max(0, len(text) - worth)
