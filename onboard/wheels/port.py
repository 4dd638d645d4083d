"""The serial port of the wheel controller. Every failure is raised as a PortLostError."""

import errno
import os
import select
import termios
from typing import Final

import serial

from groundsbot.onboard.errors import OnboardError

_READ_BYTES: Final = 4096


class PortLostError(OnboardError):
    """Error: the port is missing or was lost; it may come back."""


class EncoderPort:
    """A serial port or pseudo terminal."""

    def __init__(self, path: str, baud: int) -> None:
        self.path = path
        self.baud = baud
        self._serial: serial.Serial | None = None

    def open(self) -> None:
        """Open the port exclusively.

        Raises:
            PortLostError: the port is missing, or another program uses it.
        """
        try:
            self._serial = serial.Serial(self.path, self.baud, timeout=0, exclusive=True)
        except (serial.SerialException, OSError, termios.error, ValueError) as error:
            raise PortLostError(f"port {self.path} at {self.baud} baud cannot be opened: {_reason(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        """Return bytes as soon as some have arrived, or none if none arrive in time.

        Raises:
            PortLostError: the port was lost or is not open.
        """
        try:
            if self._serial is None:
                raise PortLostError(f"port {self.path} is not open")
            ready, _, _ = select.select([self._serial], [], [], timeout_s)
            # pyserial's `read` would call `select` a second time.
            data = os.read(self._serial.fileno(), _READ_BYTES) if ready else b""
            if ready and not data:
                raise PortLostError(f"port {self.path} was lost: it has ended")
            return data
        except BlockingIOError:  # ready at `select`, but not any more
            return b""
        # An unplugged port raises the first, then the others; TypeError if it was closed by another thread.
        except (serial.SerialException, OSError, termios.error, TypeError, ValueError) as error:
            raise PortLostError(f"port {self.path} was lost: {_reason(error)}") from error

    def close(self) -> None:
        """Close the port; never raises."""
        port, self._serial = self._serial, None
        if port is None:
            return
        try:
            port.close()
        except (OSError, termios.error):
            # The file descriptor is released in spite of the error. pyserial would close it again when it is collected,
            # and the number may belong to another file by then.
            port.fd = None
            port.is_open = False


def _reason(error: Exception) -> str:
    if getattr(error, "errno", None) == errno.EWOULDBLOCK:  # raised by the exclusive lock
        return "another program has it, a recorder perhaps; stop that first"
    return str(getattr(error, "strerror", None) or error)
