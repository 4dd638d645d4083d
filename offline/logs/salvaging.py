"""Complete logs from damaged and unfinished ones: new ones that every MCAP tool reads; the old ones are not changed."""

from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.logs.new_log import new_log
from groundsbot.onboard.errors import LogError, MessageRefusedError
from groundsbot.onboard.log import (
    Allowance,
    Event,
    EventKind,
    LogHead,
    LogLosses,
    LogMessage,
    LogWriter,
    Severity,
    files_of,
    finished_name,
    is_head_topic,
    of_pictures,
    read_head,
    read_log,
)


@dataclass(frozen=True)
class SalvagedFile:
    """Result for one file."""

    source: Path
    target: Path | None  # None: nothing in it could be used
    n_messages: int  # beside its head
    losses: LogLosses

    @property
    def is_whole(self) -> bool:
        """Whether everything that was ever written to the file is there."""
        return self.target is not None and not self.losses.n_lost

    def with_target(self, target: Path) -> "SalvagedFile":
        """Return a copy with the final place of its target."""
        return self if self.target is None else replace(self, target=target)

    def lines(self) -> list[str]:
        """Return what was salvaged and what is lost, as lines of text."""
        found = f"{self.n_messages} messages -> {self.target}" if self.target else "holds nothing that can be used"
        return [f"{self.source}: {found}", *(f"  {line}" for line in self.losses.lines())]


def salvage(log: Path, output: Path) -> list[SalvagedFile]:
    """Write what a log still holds into a new one, which appears complete or not at all.

    Args:
        log: a file, or a run folder, each file of which is salvaged separately.
        output: the new file or folder.

    Raises:
        GroundsbotError: `output` exists, nothing can be salvaged, or it cannot be written.
    """
    sources, head = files_of(log), read_head(log)
    if not log.is_dir() and output.suffix != ".mcap":
        raise OfflineError(f"{output}: must be a file name ending in .mcap, because {log} is a single file")
    if log.is_dir() and output.suffix == ".mcap":
        raise OfflineError(
            f"{output}: must name a new folder, without .mcap, because {log} is a folder, whose files "
            "are salvaged one by one"
        )
    if "/run" not in head:
        allowance = Allowance()
        reasons = "; ".join(line for source in sources for line in _losses_of(source, allowance).lines())
        raise OfflineError(f"{log}: none of its files has a /run message, so nothing can be salvaged: {reasons}")
    names = {source: finished_name(source) if log.is_dir() else output.name for source in sources}
    with new_log(output) as folder:
        allowance = Allowance()
        salvaged = [_salvage(source, folder / name, head, allowance) for source, name in names.items()]
    return [each.with_target(output / names[each.source] if log.is_dir() else output) for each in salvaged]


def _losses_of(source: Path, allowance: Allowance) -> LogLosses:
    losses = LogLosses()
    try:
        for _ in read_log(source, losses=losses, allowance=allowance):
            pass
    except LogError as error:
        losses.unusable[source] = str(error).removeprefix(f"{source}: ")
    return losses


def _salvage(source: Path, target: Path, head: LogHead, allowance: Allowance) -> SalvagedFile:
    losses = LogLosses()
    messages = read_log(source, losses=losses, allowance=allowance)
    try:
        first = next(messages, None)
    except LogError as error:
        losses.unusable[source] = str(error).removeprefix(f"{source}: ")
        first = None
    if first is None:
        return SalvagedFile(source, None, 0, losses)
    writer = LogWriter(target, head, first.log_time_ns, durable=False)
    n_messages = sum(_copy(each, writer, losses) for each in chain([first], messages) if not is_head_topic(each.topic))
    if not of_pictures([source]):
        now_ns = writer.last_log_time_ns
        writer.write("/events", _event(source, now_ns, losses), now_ns, now_ns)
    writer.close()
    return SalvagedFile(source, target, n_messages, losses)


def _copy(each: LogMessage, writer: LogWriter, losses: LogLosses) -> bool:
    try:
        at_ns = max(each.log_time_ns, writer.last_log_time_ns)
        return writer.write(each.topic, each.message, at_ns, each.publish_time_ns)
    except MessageRefusedError:
        losses.n_undecodable += 1
        return False


def _event(source: Path, now_ns: int, losses: LogLosses) -> Event:
    text = "; ".join(losses.lines()) or "nothing was lost"
    return Event(
        stamp_ns=now_ns,
        severity=Severity.SEVERITY_WARNING if losses.n_lost else Severity.SEVERITY_INFO,
        kind=EventKind.SALVAGED,
        text=f"salvaged from {source.name}: {text}",
        count=losses.n_lost,
    )
