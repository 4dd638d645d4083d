"""The address at which a page is served."""

import re
from typing import Annotated, Final, NamedTuple

from pydantic import AfterValidator

LOOPBACK: Final = "127.0.0.1"
_MOST_PORT: Final = 65_535
_ADDRESS: Final = re.compile(r"(?:(?:\[(?P<v6>[0-9A-Fa-f:.]+)\]|(?P<host>[A-Za-z0-9.-]+)):)?(?P<port>\d{1,5})")


class PageAddress(NamedTuple):
    """Host name or IP address (without brackets), and TCP port."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def parse_page_address(text: str) -> PageAddress:
    """Return the address of a text [HOST:]PORT, where HOST is a name, an IPv4 address or [an IPv6 address].

    Raises:
        ValueError: the text is no such address.
    """
    found = _ADDRESS.fullmatch(text)
    if found is None or not 0 < int(found["port"]) <= _MOST_PORT:
        raise ValueError(
            f"{text!r} is not PORT or HOST:PORT with a port of 1 to {_MOST_PORT}; "
            "give 8080, or 0.0.0.0:8080 for phones and other computers"
        )
    return PageAddress(found["v6"] or found["host"] or LOOPBACK, int(found["port"]))


def _check(text: str | int) -> str | int:
    parse_page_address(str(text))
    return text


PageText = Annotated[str | int, AfterValidator(_check)]  # of robot.yaml, where a port alone is a number
