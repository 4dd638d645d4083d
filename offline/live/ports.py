"""Addresses of what `live` serves."""

import re
import socket
from typing import Final

from groundsbot.calib.web import LOOPBACK, PageAddress, listen_at, parse_page_address
from groundsbot.offline.errors import OfflineError

_LOCAL_HOSTS: Final = ("", LOOPBACK, "localhost")


def parse_address(text: str, option: str) -> PageAddress:
    """Return the address of a PORT or HOST:PORT value.

    Args:
        text: the value.
        option: named in the error.

    Raises:
        OfflineError: it is none.
    """
    try:
        return parse_page_address(text)
    except ValueError as error:
        raise OfflineError(f"{option} {error}") from error


def parse_port(text: str, option: str) -> int:
    """Return the port of a PORT or HOST:PORT value that serves this computer only.

    Args:
        text: the value.
        option: named in the error.

    Raises:
        OfflineError: it is none, or of another computer's address.
    """
    host, _, port = text.rpartition(":")
    if not re.fullmatch(r"\d{1,5}", port) or int(port) > 65535:
        raise OfflineError(f"{option} {text}: the port must be a number up to 65535, as 8000")
    if host not in _LOCAL_HOSTS:
        raise OfflineError(
            f"{option} {text}: it is served for this computer only; give the port alone, and forward it with "
            f"`ssh -L {port}:localhost:{port}` to another"
        )
    return int(port)


def listen(port: int, option: str) -> socket.socket:
    """Return a listening socket.

    Args:
        port: TCP port on this computer's own address; 0 for any that is free.
        option: named in the error.

    Raises:
        CalibError: the port is in use.
    """
    return listen_at(PageAddress(LOOPBACK, port), option)
