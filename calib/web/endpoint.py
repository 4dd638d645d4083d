"""The address of a page: its socket, its secret, and how to open it on a phone."""

import fcntl
import importlib.util
import ipaddress
import re
import secrets
import socket
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import atomic_write, read_regular
from groundsbot.calib.web.page_address import LOOPBACK, PageAddress

_BACKLOG: Final = 32
_INTERFACES: Final = Path("/sys/class/net")
_LIBRARIES: Final = ("segno", "starlette", "uvicorn")
_TOKEN_BYTES: Final = 16
_TOKEN: Final = re.compile(r"[\w-]{22}", re.ASCII)
_MOST_TOKEN_BYTES: Final = 64
_SIOCGIFADDR: Final = 0x8915  # from linux/sockios.h: the IPv4 address of a network interface
_QUIET_ZONE: Final = 2  # light modules around a QR code


@dataclass(frozen=True)
class Access:
    """Who may open a page.

    Attributes:
        name: name of the page's cookie; browsers share cookies between the ports of a host.
        token: secret that the URL must have.
        host: name or address at which the page is served.
        is_local: only programs on this computer reach it.
    """

    name: str
    token: str
    host: str
    is_local: bool


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

    def access(self, name: str) -> Access:
        """Return who may open the page; see Access for the name."""
        return Access(name, self.token, self.address.host, self.is_local)

    def urls(self) -> list[str]:
        """Return the URLs of the page, the one for a phone first."""
        bound, port = self.listener.getsockname()[:2]
        hosts = own_hosts() if ipaddress.ip_address(bound).is_unspecified else [self.address.host]
        return [f"http://{PageAddress(host, port)}/?token={self.token}" for host in hosts]


def open_page(address: PageAddress, kept: Path, extra: str, say: Callable[[str], None], *, qr: bool) -> Endpoint:
    """Listen at the address of a page, and print its URLs.

    Args:
        address: the address; its port may be 0 for any that is free.
        kept: file that keeps the token.
        extra: extra of groundsbot, which brings the libraries of the page.
        say: called with each line.
        qr: whether to show a QR code of the first URL, unless only this computer reaches it.

    Raises:
        CalibError: a library is missing, or the address is not one of this computer, or is in use.
    """
    require_libraries(f"page {address}", _LIBRARIES, extra)
    endpoint = Endpoint(listen_at(address, "page"), address, kept_token(kept))
    for line in _invitation(endpoint, qr):
        say(line)
    return endpoint


def require_libraries(what: str, libraries: Sequence[str], extra: str) -> None:
    """Check that the libraries of a service are installed.

    Raises:
        CalibError: one is not; the message begins with `what`.
    """
    missing = [each for each in libraries if importlib.util.find_spec(each) is None]
    if missing:
        option = what.split()[0]
        raise CalibError(
            f"{what}: {missing[0]} is not installed; pip install 'groundsbot[{extra}]', or run without {option}"
        )


def _invitation(endpoint: Endpoint, qr: bool) -> Iterator[str]:
    urls = endpoint.urls()
    if qr and not endpoint.is_local:
        yield from qr_lines(urls[0])
    for url in urls:
        yield f"page: {url}"
    name = endpoint.address.host
    if endpoint.is_local and name not in (LOOPBACK, "::1", "localhost"):
        yield (
            f"page: only this computer reaches it, as {name} is {endpoint.listener.getsockname()[0]} here; "
            f"give 0.0.0.0:{endpoint.address.port} for phones"
        )


def listen_at(address: PageAddress, what: str) -> socket.socket:
    """Return a socket that listens at an address, for `what` is served there.

    Raises:
        CalibError: the address is not one of this computer, or is in use.
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
        raise CalibError(
            f"{what} {address}: cannot be served there ({reason}); give another port, or an address of this computer"
        ) from error
    return listener


def kept_token(path: Path) -> str:
    """Return the token that a file keeps, so that a phone's bookmark stays good; keep a new one if there is none.

    Where the file cannot be written, the token is of this program only.
    """
    with suppress(CalibError, OSError):
        kept = read_regular(path, _MOST_TOKEN_BYTES, follow_links=False).decode("ascii", "replace").strip()
        if _TOKEN.fullmatch(kept):
            return kept
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            temporary.touch(mode=0o600)
            temporary.write_text(f"{token}\n", encoding="ascii")
    return token


def own_hosts() -> list[str]:
    """Return addresses and names of this computer, the one that a phone reaches best first."""
    return [*_interface_addresses(), f"{socket.gethostname().partition('.')[0]}.local", LOOPBACK]


def own_names() -> set[str]:
    """Return the names of this computer, with and without a domain."""
    name = socket.gethostname().lower()
    short = name.partition(".")[0]
    return {name, short, f"{short}.local"}


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
