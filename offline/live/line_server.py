"""Lines of text for programs on the same computer: a TCP socket to which each new line is written."""

import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

from groundsbot.offline.live.ports import listen

_MOST_CLIENTS: Final = 16
_PAUSE_S: Final = 0.1


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
        self._is_closed = False
        threading.Thread(target=self._accept, name="poses", daemon=True).start()

    def write(self, lines: Sequence[str]) -> None:
        """Write lines to all clients."""
        data = "".join(f"{line}\n" for line in lines).encode()
        with self._lock:
            self._clients = [each for each in self._clients if _send(each, data)]

    def close(self) -> None:
        """End all connections."""
        self._is_closed = True
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
            except OSError:
                if self._is_closed:
                    return
                time.sleep(_PAUSE_S)  # as without free descriptors
                continue
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
        port: TCP port on this computer's own address; 0 for any that is free.
        option: named in the error.

    Raises:
        OfflineError: the port is in use.
    """
    server = LineServer(listen(port, option))
    try:
        yield server
    finally:
        server.close()
