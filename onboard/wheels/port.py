"""The serial port of the wheel controller: open, read what is there, close. Whatever goes wrong is a PortLostError."""

import errno
import os
import select
import termios
from typing import Final

import serial

from groundsbot.onboard.errors import OnboardError

_READ_BYTES: Final = 4096


class PortLostError(OnboardError):
    """The port is absent or went away; it may come back."""


class EncoderPort:
    """A serial port, real or a pseudo terminal."""

    def __init__(self, path: str, baud: int) -> None:
        self.path = path
        self.baud = baud
        self._serial: serial.Serial | None = None

    def open(self) -> None:
        """Opens the port, for this process alone.

        Raises:
            PortLostError: it is absent, or somebody else has it.
        """
        try:
            self._serial = serial.Serial(self.path, self.baud, timeout=0, exclusive=True)
        except (serial.SerialException, OSError, termios.error, ValueError) as error:
            raise PortLostError(f"port {self.path} at {self.baud} baud cannot be opened: {_reason(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        """Returns the bytes that have come as soon as there are any; none if none come in time.

        Raises:
            PortLostError: the port went away, or is not open.
        """
        try:
            if self._serial is None:
                raise PortLostError(f"port {self.path} is not open")
            ready, _, _ = select.select([self._serial], [], [], timeout_s)
            # pyserial's own `read` would first ask again whether there is something.
            data = os.read(self._serial.fileno(), _READ_BYTES) if ready else b""
            if ready and not data:
                raise PortLostError(f"port {self.path} was lost: it has ended")
            return data
        except BlockingIOError:  # it was ready, and is so no more
            return b""
        # An unplugged port raises the first, then the others; TypeError when it was closed meanwhile.
        except (serial.SerialException, OSError, termios.error, TypeError, ValueError) as error:
            raise PortLostError(f"port {self.path} was lost: {_reason(error)}") from error

    def close(self) -> None:
        """Closes the port; never fails."""
        port, self._serial = self._serial, None
        if port is None:
            return
        try:
            port.close()
        except (OSError, termios.error):
            # The port is gone already, and its number free, though the kernel complains. pyserial would close that
            # number again when it is collected, whoever has it by then.
            port.fd = None
            port.is_open = False


def _reason(error: Exception) -> str:
    if getattr(error, "errno", None) == errno.EWOULDBLOCK:  # of the lock: a port has one reader
        return "another program has it, a recorder perhaps; stop that first"
    return str(getattr(error, "strerror", None) or error)
