"""Ports of this computer, and lines of text for programs on it: a TCP socket to which each new line is written."""

import re
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

from groundsbot.offline.errors import OfflineError

LOCAL_HOSTS: Final = ("127.0.0.1", "localhost")
_MOST_CLIENTS: Final = 16


def parse_port(text: str, option: str) -> int:
    """Return the port of a PORT or HOST:PORT value.

    Args:
        text: the value.
        option: named in the error.

    Raises:
        OfflineError: it is none, or of another computer's address.
    """
    host, _, port = text.rpartition(":")
    if not re.fullmatch(r"\d{1,5}", port) or int(port) > 65535:
        raise OfflineError(f"{option} {text}: the port must be a number up to 65535, as 8000")
    if host not in ("", *LOCAL_HOSTS):
        raise OfflineError(
            f"{option} {text}: it is served for this computer only; give the port alone, and forward it with "
            f"`ssh -L {port}:localhost:{port}` to another"
        )
    return int(port)


class LineServer:
    """Clients that have connected; one that does not read is cut off, so that none is waited for.

    Attributes:
        port: the port.
    """

    def __init__(self, listener: socket.socket) -> None:
        """Begin to accept clients in a thread, until the listener is closed."""
        self.port: int = listener.getsockname()[1]
        self._listener = listener
        self._clients: list[socket.socket] = []
        self._lock = threading.Lock()
        threading.Thread(target=self._accept, name="poses", daemon=True).start()

    def write(self, lines: Sequence[str]) -> None:
        """Write lines to all clients."""
        data = "".join(f"{line}\n" for line in lines).encode()
        with self._lock:
            self._clients = [each for each in self._clients if _send(each, data)]

    def close(self) -> None:
        """End all connections."""
        with suppress(OSError):  # wakes the thread, which waits for clients
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            for each in self._clients:
                each.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:  # closed
                return
            client.setblocking(False)
            with self._lock:
                if len(self._clients) < _MOST_CLIENTS:
                    self._clients.append(client)
                else:
                    client.close()


def _send(client: socket.socket, data: bytes) -> bool:
    """Send all data or end the connection, and return whether it goes on."""
    try:
        if client.send(data) == len(data):
            return True
    except OSError:
        pass
    client.close()
    return False


@contextmanager
def serve_lines(port: int, option: str) -> Iterator[LineServer]:
    """Serve lines while the block runs.

    Args:
        port: on this computer's own address; 0 for any that is free.
        option: named in the error.

    Raises:
        OfflineError: the port is in use.
    """
    try:
        listener = socket.create_server((LOCAL_HOSTS[0], port))
    except OSError as error:
        raise OfflineError(f"{option} {port}: cannot be served there ({error.strerror}); give another port") from error
    server = LineServer(listener)
    try:
        yield server
    finally:
        server.close()
