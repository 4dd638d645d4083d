"""Who does not have the page's address gets nothing, and who floods it takes nothing from the recording.

The table of docs/robot_page.md lists these.
"""

import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from groundsbot.onboard.page.hub import MOST_WATCHERS
from tests.onboard.page.conftest import Served, page_processes, serving
from tests.support.devices.live_recording import tag_jpeg, until


def raw(served: Served, request: bytes, limit_s: float = 30.0) -> bytes:
    """What a raw request is answered with until the connection ends."""
    with socket.create_connection(("127.0.0.1", served.port), timeout=limit_s) as client:
        with suppress(OSError):  # it may be cut off while it sends
            client.sendall(request)
        answer = b""
        with suppress(ConnectionResetError):
            while piece := client.recv(1 << 16):
                answer += piece
        return answer


def status_of(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


@pytest.mark.parametrize("path", ["/", "/states", "/picture"])
@pytest.mark.parametrize("token", ["", "wrong", "\x80"])
def test_without_the_token_there_is_nothing(served: Served, path: str, token: str) -> None:
    status, body = served.ask(path, token=token)
    assert (status, json.loads(body)) == (
        403,
        {"error": "open the page with the whole address that the recorder printed"},
    )
    assert served.ask(f"{path}?token={token or 'x'}".replace("\x80", "%80"), Cookie="a=b")[0] == 403


def test_the_token_in_the_address_becomes_a_cookie(served: Served) -> None:
    asking = http.client.HTTPConnection("127.0.0.1", served.port, timeout=30.0)
    asking.request("GET", f"/?token={served.token}")
    answer = asking.getresponse()
    assert answer.status == 200
    cookie = answer.getheader("set-cookie") or ""
    assert f"groundsbot_gb1={served.token};" in cookie
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    policy = answer.getheader("content-security-policy") or ""
    assert policy.startswith("default-src 'none'; style-src 'sha256-")
    assert "frame-ancestors 'none'" in policy
    assert answer.getheader("referrer-policy") == "no-referrer"
    asking.close()


def test_other_sites_give_no_commands(served: Served) -> None:
    refused = (403, {"error": "commands come from the page itself only"})
    assert served.order("note", "x", Origin="http://evil.example") == refused
    assert served.order("note", "x", Origin="null") == refused
    assert served.order("note", "x", Content_Type="text/plain") == refused
    assert served.order("note", "x", Sec_Fetch_Site="cross-site") == refused
    status, body = served.ask("/command", "POST", b"{}", Content_Type="application/json")  # without an origin
    assert (status, json.loads(body)) == refused


def test_a_name_that_others_gave_this_address_is_not_its_own(served: Served) -> None:
    status, body = served.ask("/states", Host=f"evil.example:{served.port}")
    assert (status, json.loads(body)["error"]) == (403, "this is not the address at which the page is served")


@pytest.mark.parametrize(
    "path", ["/../../etc/passwd", "/..%2f..%2fetc%2fpasswd", "//etc/passwd", "/%00", "/picture/../states/x", "/.env"]
)
def test_no_path_leads_to_a_file(served: Served, path: str) -> None:
    status, body = served.ask(path)
    assert status == 404
    assert b"root:" not in body


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "TRACE", "HEAD", "CONNECT"])
def test_other_methods_are_refused(served: Served, method: str) -> None:
    assert served.ask("/", method)[0] == 405


def test_a_websocket_is_refused(served: Served) -> None:
    key = "dGhlIHNhbXBsZSBub25jZQ=="
    asked = served.ask("/states", Upgrade="websocket", Connection="Upgrade", Sec_WebSocket_Key=key)
    assert asked[0] == 405


def test_a_body_of_a_gigabyte_is_not_read(served: Served) -> None:
    head = (
        f"POST /command HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nCookie: groundsbot_gb1={served.token}\r\n"
        f"Origin: http://127.0.0.1:{served.port}\r\nContent-Type: application/json\r\n"
    ).encode()
    announced = raw(served, head + b"Content-Length: 1073741824\r\n\r\n" + bytes(1 << 16))
    assert status_of(announced) == 413
    piece = b"10000\r\n" + b" " * 0x10000 + b"\r\n"
    in_pieces = raw(served, head + b"Transfer-Encoding: chunked\r\n\r\n" + 64 * piece)
    assert not in_pieces or status_of(in_pieces) == 400
    long_head = raw(served, b"GET / HTTP/1.1\r\nX: " + b"x" * (1 << 20))
    assert not long_head or status_of(long_head) == 400


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b"[" * 4000, b'{"command": 1}', b'{"command": ["note"]}', b"\xff"])
def test_a_body_that_is_no_command_is_refused(served: Served, body: bytes) -> None:
    own = {"Content_Type": "application/json", "Origin": f"http://127.0.0.1:{served.port}"}
    status, answer = served.ask("/command", "POST", body, **own)
    assert status == 400
    assert "error" in json.loads(answer)


def test_there_are_only_so_many_browsers(served: Served) -> None:
    with ExitStack() as stack:
        for _ in range(MOST_WATCHERS):
            next(stack.enter_context(served.watching()))
        status, body = served.ask("/states")
        assert (status, json.loads(body)) == (503, {"error": f"{MOST_WATCHERS} browsers watch already"})
    until(lambda: _can_watch(served), "room for one more")


def _can_watch(served: Served) -> bool:
    with suppress(AssertionError), served.watching() as states:
        return next(states) is not None
    return False


@pytest.fixture(scope="module")
def flooded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, list[int]]]:
    """A recording whose page is flooded, and the line numbers that its wheels sent in vain."""
    with serving(tmp_path_factory.mktemp("flooded"), tag_jpeg()) as (served, driver):
        served.wait_for_state(lambda state: state["picture"] > 0)
        (before,) = page_processes(served.process.pid)
        _hold_connections(served, 1000)
        _read_nothing(served, 50)
        _ask_in_threads(served, 50)
        for _ in range(500):
            raw(served, b"\x00\xff no HTTP\r\n\r\n")
        served.wait_for_state(lambda state: state["state"] == "recording")
        assert page_processes(served.process.pid) == [before]
        served.end()
        yield served, driver.refused


def _hold_connections(served: Served, n: int) -> None:
    """Opens connections that send the begin of a request each, and nothing more."""
    with ExitStack() as stack:
        for _ in range(n):
            client = stack.enter_context(socket.socket())
            client.setblocking(False)
            with suppress(BlockingIOError):
                client.connect(("127.0.0.1", served.port))
            with suppress(OSError):
                client.send(b"GET / HTTP/1.1\r\nHost: ")
        time.sleep(1.0)


def _read_nothing(served: Served, n: int) -> None:
    """Requests pictures and states again and again without reading an answer."""
    asking = (
        f"GET /picture HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nCookie: groundsbot_gb1={served.token}\r\n\r\n"
    ).encode()
    with ExitStack() as stack:
        for _ in range(n):
            client = stack.enter_context(socket.socket())
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
            client.settimeout(1.0)
            with suppress(OSError):
                client.connect(("127.0.0.1", served.port))
                client.sendall(100 * asking)
        time.sleep(1.0)


def _ask_in_threads(served: Served, n: int) -> None:
    """Has as many clients as that ask for pictures and give commands, as quickly as they are answered, for 3 s."""
    end_s = time.monotonic() + 3.0

    def ask() -> None:
        while time.monotonic() < end_s:
            with suppress(OSError, http.client.HTTPException, ValueError):
                served.ask("/picture")
                served.order("note", "flood")

    clients = [threading.Thread(target=ask) for _ in range(n)]
    for each in clients:
        each.start()
    for each in clients:
        each.join()


def test_a_flood_takes_nothing_from_the_recording(flooded: tuple[Served, list[int]]) -> None:
    served, refused = flooded
    assert served.process.returncode == 0
    assert "lost: " not in "".join(served.said)
    assert refused == []
    assert len(served.said) < 60  # a line for each bad request would fill the journal


def test_a_flood_of_notes_is_limited(flooded: tuple[Served, list[int]]) -> None:
    served, _ = flooded
    notes = [each.text for each in served.events() if each.kind == "note"]
    assert 10 <= len(notes) < 40  # ten at once, and one more each second
