"""Display of a capture: a live panel in a terminal, or plain lines."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from groundsbot.calib.foundation import printable
from groundsbot.onboard.capture.guide import Advice, CaptureGuide

_PERIOD_S: Final = 2.0  # between two plain lines without a new picture
_FULL: Final = "■"
_BARE: Final = "·"


class CaptureView:
    """Display of advice on a console."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live: Live | None = None
        self._shown = ""
        self._shown_at_s = float("-inf")

    @contextmanager
    def live(self) -> Iterator[None]:
        """Show a panel while the block runs, if the console is a terminal."""
        if not self._console.is_terminal:
            yield
            return
        with Live(console=self._console, auto_refresh=False) as self._live:
            yield
        self._live = None

    def show(self, advice: Advice, guide: CaptureGuide) -> None:
        """Show the advice for a picture. In a terminal a bell rings for each picture taken."""
        if self._live is not None:
            if advice.keep:
                self._console.bell()
            self._live.update(_panel(advice, guide), refresh=True)
            return
        now_s = self._console.get_time()
        if advice.keep or (advice.text != self._shown and now_s - self._shown_at_s >= _PERIOD_S):
            self.say(f"{guide.kept} of {guide.wanted}: {advice.text}")
            self._shown, self._shown_at_s = advice.text, now_s

    def say(self, text: str) -> None:
        """Print one line."""
        self._console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


def _panel(advice: Advice, guide: CaptureGuide) -> Panel:
    """Return a panel with the number of pictures, the advice, covered regions of the picture, and missing views."""
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
