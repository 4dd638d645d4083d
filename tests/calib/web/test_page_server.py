"""A page's server bounds how many clients there are, and how long one may take to ask and to listen."""

import socket
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from starlette.responses import PlainTextResponse, StreamingResponse
from starlette.types import Receive, Scope, Send

from groundsbot.calib.web import server as web_server
from groundsbot.calib.web.endpoint import Access, open_page
from groundsbot.calib.web.guard import Guard
from groundsbot.calib.web.page_address import PageAddress
from groundsbot.calib.web.server import MOST_CONNECTIONS, PageServer
from tests.support.devices.live_recording import PATIENCE_S, until

REQUEST = b"GET %s?token=secret HTTP/1.1\r\nHost: localhost\r\n\r\n"


async def app(scope: Scope, receive: Receive, send: Send) -> None:
    async def pieces() -> AsyncIterator[bytes]:
        for _ in range(1000):
            yield bytes(1 << 16)

    answer = StreamingResponse(pieces()) if scope["path"] == "/large" else PlainTextResponse("here")
    await answer(scope, receive, send)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PageServer]:
    endpoint = open_page(PageAddress("127.0.0.1", 0), tmp_path / "token", "robot", lambda _: None, qr=False)
    made = PageServer(Guard(app, Access("test", "secret", "127.0.0.1", is_local=True)))
    thread = threading.Thread(target=made.run, args=([endpoint.listener],), daemon=True)
    thread.start()
    until(lambda: made.started, "the server")
    yield made
    made.should_exit = made.force_exit = True
    thread.join(PATIENCE_S)
    endpoint.listener.close()


def connect(server: PageServer, request: bytes) -> socket.socket:
    client = socket.create_connection(server.servers[0].sockets[0].getsockname(), timeout=PATIENCE_S)
    with suppress(OSError):
        client.sendall(request)
    return client


def is_cut_off(client: socket.socket) -> bool:
    try:
        return client.recv(1) == b""
    except ConnectionResetError:
        return True


def test_a_connection_too_many_is_cut_off(server: PageServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "_LISTEN_S", PATIENCE_S)
    with ExitStack() as stack:
        for _ in range(MOST_CONNECTIONS):
            client = stack.enter_context(connect(server, REQUEST % b"/large"))
            assert client.recv(12) == b"HTTP/1.1 200"
        assert is_cut_off(stack.enter_context(connect(server, REQUEST % b"/")))
    until(lambda: not server.server_state.connections, "the end of the clients")
    with connect(server, REQUEST % b"/") as client:
        assert client.recv(12) == b"HTTP/1.1 200"


@pytest.mark.parametrize(
    "part", [b"", b"GET / HTTP/1.1\r\nHost: ", REQUEST[:-4] % b"/" + b"\r\nContent-Length: 9\r\n\r\n1"]
)
def test_a_client_that_does_not_ask_to_the_end_is_cut_off(
    server: PageServer, monkeypatch: pytest.MonkeyPatch, part: bytes
) -> None:
    monkeypatch.setattr(web_server, "_ASK_S", 0.1)
    with connect(server, part % b"/" if b"%s" in part else part):
        until(lambda: not server.server_state.connections, "the end of the connection")


def test_a_client_that_does_not_read_is_cut_off(server: PageServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "_LISTEN_S", 0.1)
    with connect(server, REQUEST % b"/large") as client:
        assert client.recv(12) == b"HTTP/1.1 200"
        (held,) = server.server_state.connections
        assert held.transport.get_write_buffer_size() < 1 << 20
        until(lambda: not server.server_state.connections, "the end of the connection")
