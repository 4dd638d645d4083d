"""Lines over TCP: each client gets those since it came, and none is waited for."""

import socket

import pytest

from groundsbot.calib.errors import CalibError
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.live import line_server
from groundsbot.offline.live.line_server import LineServer, serve_lines
from groundsbot.offline.live.ports import parse_port
from tests.support.devices.live_recording import until


def connect(server: LineServer) -> socket.socket:
    n_before = len(server._clients)
    client = socket.create_connection(("127.0.0.1", server.port), timeout=120.0)
    until(lambda: len(server._clients) == n_before + 1, "the client")
    return client


def test_each_client_gets_the_lines_since_it_came() -> None:
    with serve_lines(0, "--poses") as server:
        server.write(["before"])
        first = connect(server)
        server.write(["one"])
        second = connect(server)
        server.write(["two", "three"])
        assert first.makefile().readline() == "one\n"
        assert second.makefile().readline() == "two\n"
    assert second.recv(100) == b""  # the end
    for each in (first, second):
        each.close()


def test_a_client_that_does_not_read_is_cut_off_and_others_go_on() -> None:
    with serve_lines(0, "--poses") as server:
        slow = connect(server)
        for _ in range(10_000):
            server.write(["x" * 10_000])
            if not server._clients:
                break
        assert not server._clients
        quick = connect(server)
        server.write(["on"])
        assert quick.recv(100) == b"on\n"
        for each in (slow, quick):
            each.close()


def test_more_clients_than_allowed_are_turned_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_server, "_MOST_CLIENTS", 1)
    with serve_lines(0, "--poses") as server:
        first = connect(server)
        with socket.create_connection(("127.0.0.1", server.port), timeout=120.0) as second:
            assert second.recv(100) == b""
        first.close()


def test_a_port_in_use_is_refused() -> None:
    with (
        serve_lines(0, "--poses") as server,
        pytest.raises(CalibError, match=f"^--poses 127.0.0.1:{server.port}: cannot be served there"),
        serve_lines(server.port, "--poses"),
    ):
        pass


@pytest.mark.parametrize("text", ["8000", "localhost:8000", "127.0.0.1:8000"])
def test_a_port_of_this_computer_is_taken(text: str) -> None:
    assert parse_port(text, "--poses") == 8000


@pytest.mark.parametrize(
    ("text", "reason"),
    [("http", "must be a number"), ("70000", "must be a number"), ("0.0.0.0:8000", "ssh -L 8000:localhost:8000")],
)
def test_other_addresses_are_refused_with_a_way_out(text: str, reason: str) -> None:
    with pytest.raises(OfflineError, match=reason):
        parse_port(text, "--poses")
