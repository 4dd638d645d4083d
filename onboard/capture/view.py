"""Capturing pictures of a board, for the person who holds it: live in a terminal, or as plain lines."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from groundsbot.onboard.capture.guide import Advice, CaptureGuide

_PERIOD_S: Final = 2.0  # between two plain lines that tell of no new picture
_FULL: Final = "■"
_BARE: Final = "·"


class CaptureView:
    """Tells what to do next."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live: Live | None = None
        self._told = ""
        self._told_at_s = float("-inf")

    @contextmanager
    def live(self) -> Iterator[None]:
        """While the block runs, in a terminal: ever anew in one place."""
        if not self._console.is_terminal:
            yield
            return
        with Live(console=self._console, auto_refresh=False) as self._live:
            yield
        self._live = None

    def show(self, advice: Advice, guide: CaptureGuide) -> None:
        """After each picture; a bell rings for those taken, as nobody looks at the screen all the time."""
        if self._live is not None:
            if advice.keep:
                self._console.bell()
            self._live.update(_panel(advice, guide), refresh=True)
            return
        now_s = self._console.get_time()
        if advice.keep or (advice.text != self._told and now_s - self._told_at_s >= _PERIOD_S):
            self.say(f"{guide.kept} of {guide.wanted}: {advice.text}")
            self._told, self._told_at_s = advice.text, now_s

    def say(self, text: str) -> None:
        """One line that stays."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def _panel(advice: Advice, guide: CaptureGuide) -> Panel:
    """Pictures so far, what to do, the picture's regions (filled where covered), and all that is missing."""
    spread = guide.spread
    regions = [" ".join(_FULL if spread.is_covered(row, column) else _BARE for column in range(3)) for row in range(3)]
    rows = [
        Text(f"{guide.kept} of {guide.wanted} pictures"),
        Text(advice.text, style="bold green" if advice.keep else "bold" if advice.seen else "bold yellow"),
        Text(),
        *(Text(f"  {row}") for row in regions),
        Text(),
        *(Text(f"missing: {each}", style="dim") for each in guide.missing),
        Text("Ctrl-C ends and keeps what there is", style="dim"),
    ]
    return Panel(Group(*rows), title=f"groundsbot capture {guide.board.specification}", border_style="green")
