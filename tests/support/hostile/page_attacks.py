"""Who does not have a page's address gets nothing: tests of every page, and clients that flood one.

The tables of docs/robot_page.md and docs/live.md list these.
"""

import http.client
import json
import re
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass

import pytest


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass(frozen=True)
class Site:
    """A page that is served on this computer.

    Attributes:
        url: its address, with the token.
        cookie: name of its cookie.
        paths: what it has.
        largest: the one of them that has the longest answer.
        style: begin of its policy's sources of styles.
        takes_commands: whether there are POST requests.
    """

    url: str
    cookie: str
    paths: tuple[str, ...]
    largest: str
    style: str
    takes_commands: bool

    @property
    def port(self) -> int:
        return int(re.findall(r":(\d+)/", self.url)[0])

    @property
    def token(self) -> str:
        return self.url.partition("token=")[2]

    def request(
        self, path: str, method: str = "GET", body: bytes | None = None, token: str | None = None, **headers: str
    ) -> tuple[int, bytes, http.client.HTTPMessage]:
        """Status, body and headers of the answer to a request with the token; a header's name has _ for -."""
        asking = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120.0)
        every = {name.replace("_", "-"): text for name, text in headers.items()}
        every.setdefault("Cookie", f"{self.cookie}={self.token if token is None else token}")
        try:
            asking.request(method, path, body, every)
            answer = asking.getresponse()
            is_stream = (answer.getheader("content-type") or "").startswith("text/event-stream")
            return answer.status, b"" if is_stream else answer.read(), answer.headers
        finally:
            asking.close()

    def ask(
        self, path: str, method: str = "GET", body: bytes | None = None, token: str | None = None, **headers: str
    ) -> tuple[int, bytes]:
        """Status and body, as `request`."""
        return self.request(path, method, body, token, **headers)[:2]

    def send(self, request: bytes, limit_s: float = 30.0) -> bytes:
        """What a raw request is answered with until the connection ends."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=limit_s) as client:
            with suppress(OSError):  # it may be cut off while it sends
                client.sendall(request)
            answer = b""
            with suppress(ConnectionResetError):
                while piece := client.recv(1 << 16):
                    answer += piece
            return answer

    def hold_connections(self, n: int) -> None:
        """Opens connections that send the begin of a request each, and nothing more."""
        with ExitStack() as stack:
            for _ in range(n):
                client = stack.enter_context(socket.socket())
                client.setblocking(False)
                with suppress(BlockingIOError):
                    client.connect(("127.0.0.1", self.port))
                with suppress(OSError):
                    client.send(b"GET / HTTP/1.1\r\nHost: ")
            time.sleep(1.0)

    def read_nothing(self, n: int, meanwhile: Callable[[], None] = lambda: None) -> None:
        """Requests the longest answer again and again without reading it."""
        asking = (
            f"GET {self.largest} HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nCookie: {self.cookie}={self.token}\r\n\r\n"
        ).encode()
        with ExitStack() as stack:
            for _ in range(n):
                client = stack.enter_context(socket.socket())
                client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
                client.settimeout(1.0)
                with suppress(OSError):
                    client.connect(("127.0.0.1", self.port))
                    client.sendall(100 * asking)
            time.sleep(1.0)
            meanwhile()

    def send_junk(self, n: int) -> None:
        """Sends requests that are no HTTP."""
        for _ in range(n):
            self.send(b"\x00\xff no HTTP\r\n\r\n")


def in_threads(n: int, seconds: float, act: Callable[[], object]) -> None:
    """Has as many clients do something for as long, as quickly as they are answered."""
    end_s = time.monotonic() + seconds

    def repeat() -> None:
        while time.monotonic() < end_s:
            with suppress(OSError, http.client.HTTPException, ValueError):
                act()

    clients = [threading.Thread(target=repeat) for _ in range(n)]
    for each in clients:
        each.start()
    for each in clients:
        each.join()


def status_of(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


class PageAttacks:
    """Tests of a page; the module has a fixture `site`."""

    @pytest.mark.parametrize("token", ["", "wrong", "\x80"])
    def test_without_the_token_there_is_nothing(self, site: Site, token: str) -> None:
        for path in site.paths:
            status, body = site.ask(path, token=token)
            refused = {"error": "open the page with the whole address that the program printed"}
            assert (status, json.loads(body)) == (403, refused)
            assert site.ask(f"{path}?token={token or 'x'}".replace("\x80", "%80"), Cookie="a=b")[0] == 403

    def test_the_token_in_the_address_becomes_a_cookie(self, site: Site) -> None:
        status, _, headers = site.request(f"/?token={site.token}", Cookie="a=b")
        assert status == 200
        cookie = headers["set-cookie"]
        assert f"{site.cookie}={site.token};" in cookie
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        for path in site.paths:
            assert site.ask(path)[0] == 200

    def test_the_policy_lets_the_pages_own_script_run_only(self, site: Site) -> None:
        headers = site.request("/")[2]
        policy = headers["content-security-policy"]
        assert policy.startswith(f"default-src 'none'; style-src {site.style}")
        (script,) = re.findall("script-src (.*?);", policy)
        assert "'sha256-" in script
        assert "unsafe" not in script
        assert "frame-ancestors 'none'" in policy
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["x-content-type-options"] == "nosniff"

    def test_a_name_that_others_gave_this_address_is_not_its_own(self, site: Site) -> None:
        for host in ("evil.example", f"evil.example:{site.port}", ""):
            status, body = site.ask(site.paths[-1], Host=host)
            assert (status, json.loads(body)["error"]) == (403, "this is not the address at which the page is served")
        assert site.ask("/", Host=f"localhost:{site.port}")[0] == 200

    @pytest.mark.parametrize(
        "path", ["/../../etc/passwd", "/..%2f..%2fetc%2fpasswd", "//etc/passwd", "/%00", "/x/../states/x", "/.env"]
    )
    def test_no_path_leads_to_a_file(self, site: Site, path: str) -> None:
        for begin in ("", site.paths[-1]):
            status, body = site.ask(begin + path)
            assert status == 404
            assert b"root:" not in body

    @pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "TRACE", "HEAD", "CONNECT", "POST"])
    def test_other_methods_are_refused(self, site: Site, method: str) -> None:
        assert site.ask("/", method)[0] == (403 if method == "POST" and site.takes_commands else 405)

    def test_a_websocket_is_refused(self, site: Site) -> None:
        key = "dGhlIHNhbXBsZSBub25jZQ=="
        asked = site.ask(site.paths[-1], Upgrade="websocket", Connection="Upgrade", Sec_WebSocket_Key=key)
        assert asked[0] == 405

    def test_a_body_of_a_gigabyte_is_not_read(self, site: Site) -> None:
        head = (
            f"POST /command HTTP/1.1\r\nHost: 127.0.0.1:{site.port}\r\nCookie: {site.cookie}={site.token}\r\n"
            f"Origin: http://127.0.0.1:{site.port}\r\nContent-Type: application/json\r\n"
        ).encode()
        announced = site.send(head + b"Content-Length: 1073741824\r\n\r\n" + bytes(1 << 16))
        assert status_of(announced) == (413 if site.takes_commands else 405)
        piece = b"10000\r\n" + b" " * 0x10000 + b"\r\n"
        in_pieces = site.send(head + b"Transfer-Encoding: chunked\r\n\r\n" + 64 * piece)
        assert not in_pieces or status_of(in_pieces) == (400 if site.takes_commands else 405)
        long_head = site.send(b"GET / HTTP/1.1\r\nX: " + b"x" * (1 << 20))
        assert not long_head or status_of(long_head) == 400
