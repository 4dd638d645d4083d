"""The address of the page: its socket, its secret, and how to open it on a phone."""

import fcntl
import ipaddress
import re
import secrets
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import atomic_write, read_regular
from groundsbot.calib.robot import LOOPBACK, PageAddress
from groundsbot.onboard.errors import OnboardError

_BACKLOG: Final = 32
_INTERFACES: Final = Path("/sys/class/net")
TOKEN_NAME: Final = ".page_token"
_TOKEN_BYTES: Final = 16
_TOKEN: Final = re.compile(r"[\w-]{22}", re.ASCII)
_MOST_TOKEN_BYTES: Final = 64
_SIOCGIFADDR: Final = 0x8915  # from linux/sockios.h: the IPv4 address of a network interface
_QUIET_ZONE: Final = 2  # light modules around a QR code


@dataclass(frozen=True)
class Endpoint:
    """Where the page is served, and the token that opens it.

    Attributes:
        listener: the listening socket.
        address: its address.
        token: secret that the URL must have.
    """

    listener: socket.socket
    address: PageAddress
    token: str

    @property
    def is_local(self) -> bool:
        """Whether only programs on this computer reach it."""
        return ipaddress.ip_address(self.listener.getsockname()[0]).is_loopback

    def urls(self) -> list[str]:
        """Return the URLs of the page, the one for a phone first."""
        bound = ipaddress.ip_address(self.listener.getsockname()[0])
        hosts = own_hosts() if bound.is_unspecified else [self.address.host]
        return [f"http://{PageAddress(host, self.address.port)}/?token={self.token}" for host in hosts]


def open_endpoint(address: PageAddress, folder: Path) -> Endpoint:
    """Listen at the address of the page.

    Args:
        address: the address.
        folder: keeps the token.

    Raises:
        OnboardError: the address is not one of this computer, or is in use.
    """
    return Endpoint(listen_at(address, "page"), address, kept_token(folder))


def listen_at(address: PageAddress, what: str) -> socket.socket:
    """Return a socket that listens at an address, for `what` is served there.

    Raises:
        OnboardError: the address is not one of this computer, or is in use.
    """
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(
            address.host, address.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(place)
            listener.listen(_BACKLOG)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise OnboardError(
            f"{what} {address}: cannot be served there ({reason}); give another port, or an address of this computer"
        ) from error
    return listener


def kept_token(folder: Path) -> str:
    """Return the token that a folder keeps, so that a phone's bookmark stays good; keep a new one if there is none.

    Where the folder cannot be written, the token is of this program only.
    """
    path = folder / TOKEN_NAME
    with suppress(CalibError, OSError):
        kept = read_regular(path, _MOST_TOKEN_BYTES, follow_links=False).decode("ascii", "replace").strip()
        if _TOKEN.fullmatch(kept):
            return kept
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            temporary.touch(mode=0o600)
            temporary.write_text(f"{token}\n", encoding="ascii")
    return token


def own_hosts() -> list[str]:
    """Return addresses and names of this computer, the one that a phone reaches best first."""
    return [*_interface_addresses(), f"{socket.gethostname().partition('.')[0]}.local", LOOPBACK]


def qr_lines(text: str) -> Iterator[str]:
    """Yield the lines of a QR code for a dark terminal, two rows of modules in a line.

    Raises:
        ModuleNotFoundError: segno is not installed.
    """
    import segno

    rows = [bytes(row) for row in segno.make(text, error="l", micro=False).matrix_iter(border=_QUIET_ZONE)]
    rows += [bytes(len(rows[0]))] * (len(rows) % 2)
    marks = {(0, 0): "█", (0, 1): "▀", (1, 0): "▄", (1, 1): " "}
    for upper, lower in zip(rows[::2], rows[1::2], strict=True):
        yield "".join(marks[bool(a), bool(b)] for a, b in zip(upper, lower, strict=True))


def _interface_addresses() -> list[str]:
    """Return the IPv4 addresses of the network interfaces, without those of this computer alone.

    Those of hardware come first: no phone reaches a bridge, as containers have it.
    """
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for interface in sorted(_INTERFACES.glob("*"), key=lambda each: (not (each / "device").exists(), each.name)):
            try:
                answer = fcntl.ioctl(asking, _SIOCGIFADDR, struct.pack("256s", interface.name.encode()[:15]))
            except OSError:  # an interface without an address
                continue
            address = ipaddress.IPv4Address(answer[20:24])
            if not address.is_loopback:
                found.append(address)
    return [str(each) for each in sorted(found, key=lambda each: each.is_link_local)]
