"""Recording of a run with its status, its console lines and systemd's notifications."""

from collections.abc import Callable
from pathlib import Path
from threading import Event as StopEvent
from typing import Final

from groundsbot.onboard.log import Event
from groundsbot.onboard.monitoring.housekeeping import Housekeeper
from groundsbot.onboard.monitoring.status import Status
from groundsbot.onboard.process import Notifier, keep_memory
from groundsbot.onboard.recorder import LiveRecorder, RobotFiles, Watcher

_KEPT_BYTES: Final = 16 << 20  # free memory that the recorder keeps; enough for several chunks of pictures


class Recording:
    """Recorder of one run after another.

    Attributes:
        recorder: the recorder of the present or the last run; None before the first.
        output: folder for run folders.
    """

    def __init__(self, files: RobotFiles, output: Path, status: Path, say: Callable[[str], None]) -> None:
        """Prepare.

        Args:
            files: the robot.
            output: folder for run folders.
            status: path of the status file.
            say: called with each line for the console.
        """
        self.recorder: LiveRecorder | None = None
        self._files = files
        self.output = output
        self._status = status
        self._say = say
        self._notifier = Notifier()

    def run(
        self,
        stop: StopEvent,
        watcher: Watcher | None = None,
        on_status: Callable[[Status], None] | None = None,
        goes_on: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Record a run until `stop` is set, and return whether nothing was lost.

        Args:
            stop: ends the run.
            watcher: see LiveRecorder.
            on_status: see Housekeeper.
            goes_on: see Housekeeper.

        Raises:
            OnboardError: recording cannot start or continue.
        """

        def report_event(event: Event) -> None:
            self._say(f"{event.kind}: {event.text}")
            keeper.note(event)

        recorder = LiveRecorder(self._files, self.output, stop, report_event, self._say, watcher)
        keeper = Housekeeper(recorder, self._status, self._notifier, self._say, on_status=on_status, goes_on=goes_on)
        if self.recorder is None:
            keep_memory(_KEPT_BYTES)
        self.recorder = recorder
        keeper.start()
        try:
            recorder.run()
        finally:
            keeper.end()
        core = recorder.core
        counts = ", ".join(f"{count} {topic}" for topic, count in sorted(core.written.items()))
        self._say(f"{core.folder}: {counts or 'nothing'} on the disk")
        if core.losses:
            lost = ", ".join(f"{count} {what}" for what, count in sorted(core.losses.items()))
            self._say(f"lost: {lost}")
        return not core.losses

    def stay_alive(self) -> None:
        """Reset systemd's watchdog while no run is recorded."""
        self._notifier.alive("no run is recorded; the page can start one")
