"""Notifications of a service to systemd, see sd_notify(3)."""

import os
import socket
from typing import Final

from groundsbot.calib.foundation import printable

_US_PER_S: Final = 1_000_000


class Notifier:
    """Sender of notifications, which does nothing if systemd did not start the process.

    Attributes:
        watchdog_s: time without `alive` after which systemd restarts the service; None without a watchdog.
    """

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # an abstract socket
            self._address = "\0" + self._address[1:]
        watchdog_us = os.environ.get("WATCHDOG_USEC", "")
        for_us = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(watchdog_us) / _US_PER_S if watchdog_us.isdecimal() and for_us else None

    def ready(self) -> None:
        """Report that the service has started."""
        self._say("READY=1")

    def alive(self, text: str) -> None:
        """Report that the service is well, which resets the watchdog; `systemctl status` shows `text`."""
        self._say(f"WATCHDOG=1\nSTATUS={_one_line(text)}")

    def notify_trouble(self, text: str) -> None:
        """Report a text without resetting the watchdog."""
        self._say(f"STATUS={_one_line(text)}")

    def stopping(self) -> None:
        """Report that the service is stopping."""
        self._say("STOPPING=1")

    def _say(self, text: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as speaker:
                speaker.setblocking(False)
                speaker.sendto(text.encode(), self._address)
        except OSError:
            return  # a failed notification must not end the recording


def _one_line(text: str) -> str:
    """Return a text as one line, as each line of a notification is a message of its own."""
    return " ".join(printable(text).split())
