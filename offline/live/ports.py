"""Ports that serve this computer only."""

import re
import socket
from typing import Final

from groundsbot.offline.errors import OfflineError

LOCAL_HOSTS: Final = ("127.0.0.1", "localhost")


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


def listen(port: int, option: str) -> socket.socket:
    """Return a listening socket.

    Args:
        port: on this computer's own address; 0 for any that is free.
        option: named in the error.

    Raises:
        OfflineError: the port is in use.
    """
    try:
        return socket.create_server((LOCAL_HOSTS[0], port))
    except OSError as error:
        raise OfflineError(f"{option} {port}: cannot be served there ({error.strerror}); give another port") from error
