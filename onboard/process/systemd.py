"""What systemd wants to hear from a service: that it is ready, that it is well, that it stops. See sd_notify(3)."""

import os
import socket
from typing import Final

_US_PER_S: Final = 1_000_000


class Notifier:
    """Speaks to systemd where it listens, and to nobody else.

    Attributes:
        watchdog_s: how long systemd waits for a sign of life before it starts the service again; None: for ever.
    """

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # of the abstract kind
            self._address = "\0" + self._address[1:]
        watchdog_us = os.environ.get("WATCHDOG_USEC", "")
        for_us = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(watchdog_us) / _US_PER_S if watchdog_us.isdecimal() and for_us else None

    def ready(self) -> None:
        """The service is up."""
        self._say("READY=1")

    def alive(self, text: str) -> None:
        """The service is well; `text` is shown by `systemctl status`."""
        self._say(f"WATCHDOG=1\nSTATUS={text}")

    def notify_trouble(self, text: str) -> None:
        """The service is not well: no sign of life."""
        self._say(f"STATUS={text}")

    def stopping(self) -> None:
        """The service is on its way down."""
        self._say("STOPPING=1")

    def _say(self, text: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as speaker:
                speaker.setblocking(False)
                speaker.sendto(text.encode(), self._address)
        except OSError:
            return  # recording matters more
