"""The page's address: what is accepted, what is printed, and how a phone opens it."""

import socket
import stat
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.calib.errors import CalibError
from groundsbot.calib.web import endpoint as web_endpoint
from groundsbot.calib.web.endpoint import Endpoint, kept_token, open_page, own_hosts, own_names, qr_lines
from groundsbot.calib.web.page_address import PageAddress, parse_page_address
from tests.support.hostile.page_attacks import free_port

TOKEN_NAME = ".page_token"


def open_endpoint(address: PageAddress, folder: Path) -> Endpoint:
    return open_page(address, folder / TOKEN_NAME, "robot", lambda _: None, qr=False)


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("8080", "127.0.0.1", 8080),
        ("0.0.0.0:80", "0.0.0.0", 80),
        ("gb1.local:8080", "gb1.local", 8080),
        ("[::1]:9", "::1", 9),
    ],
)
def test_an_address_is_a_port_with_or_without_a_host(text: str, host: str, port: int) -> None:
    assert parse_page_address(text) == PageAddress(host, port)
    assert parse_page_address(str(PageAddress(host, port))) == PageAddress(host, port)


@pytest.mark.parametrize("text", ["", "0", "65536", "host", "::1:80", "a b:80", "http://x:80", "1.2.3.4:", "-1"])
def test_other_texts_are_no_address(text: str) -> None:
    with pytest.raises(ValueError, match=r"is not PORT or HOST:PORT with a port of 1 to 65535; give 8080"):
        parse_page_address(text)


def test_a_port_alone_is_of_this_computer_only(tmp_path: Path) -> None:
    endpoint = open_endpoint(parse_page_address(str(free_port())), tmp_path)
    assert endpoint.is_local
    (url,) = endpoint.urls()
    assert url == f"http://127.0.0.1:{endpoint.address.port}/?token={endpoint.token}"
    endpoint.listener.close()


def test_a_page_for_all_networks_has_an_address_of_this_computer(tmp_path: Path) -> None:
    endpoint = open_endpoint(PageAddress("0.0.0.0", free_port()), tmp_path)
    assert not endpoint.is_local
    hosts = [url.partition("://")[2].partition(":")[0] for url in endpoint.urls()]
    assert hosts[-1] == "127.0.0.1"
    assert "0.0.0.0" not in hosts
    endpoint.listener.close()


@pytest.mark.parametrize(("host", "reason"), [("192.0.2.1", "Cannot assign"), ("nowhere.invalid", "not known|resol")])
def test_an_address_of_another_computer_is_one_line(host: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(CalibError, match=f"page {host}:8080: cannot be served there .*({reason})"):
        open_endpoint(PageAddress(host, 8080), tmp_path / "logs")
    assert not (tmp_path / "logs").exists()


def test_a_name_that_is_this_computers_alone_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    found = (socket.AF_INET, socket.SOCK_STREAM, 0, "", ("127.0.1.1", port))  # as on Debian
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_arguments, **_options: [found])
    said: list[str] = []
    endpoint = open_page(PageAddress("gb1", port), tmp_path / TOKEN_NAME, "robot", said.append, qr=True)
    assert said == [
        f"page: http://gb1:{port}/?token={endpoint.token}",
        f"page: only this computer reaches it, as gb1 is 127.0.1.1 here; give 0.0.0.0:{port} for phones",
    ]
    endpoint.listener.close()


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(CalibError, match=rf"page 127.0.0.1:{port}: .*in use.*; give another port"):
            open_endpoint(PageAddress("127.0.0.1", port), tmp_path)


def test_a_missing_library_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_endpoint, "_LIBRARIES", ("segno", "no_such_library"))
    wanted = r"^page 127.0.0.1:8080: no_such_library is not installed; pip install 'groundsbot\[robot\]'"
    with pytest.raises(CalibError, match=wanted):
        open_endpoint(parse_page_address("8080"), tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_name_that_is_printed_is_one_of_this_computers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "GB1.example.org")
    assert own_names() == {"gb1.example.org", "gb1", "gb1.local"}
    assert {each.lower() for each in own_hosts()} & own_names() == {"gb1.local"}


def test_the_token_is_kept_for_the_next_start(tmp_path: Path) -> None:
    token = kept_token(tmp_path / "logs" / TOKEN_NAME)
    assert len(token) == 22
    assert kept_token(tmp_path / "logs" / TOKEN_NAME) == token
    path = tmp_path / "logs" / TOKEN_NAME
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    path.write_text("short")
    assert kept_token(tmp_path / "logs" / TOKEN_NAME) not in ("short", token)


def test_no_other_file_becomes_the_token(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("x" * 22)
    (tmp_path / TOKEN_NAME).symlink_to(other)
    assert kept_token(tmp_path / TOKEN_NAME) != "x" * 22
    assert other.read_text() == "x" * 22


def test_the_qr_code_holds_the_url() -> None:
    url = "http://192.168.4.1:8080/?token=abcdefghijklmnopqrstuv"
    modules = {"█": (255, 255), "▀": (255, 0), "▄": (0, 255), " ": (0, 0)}  # a light module is lit on a dark terminal
    lines = [np.array([modules[each] for each in line]).T for line in qr_lines(url)]
    picture = np.vstack(lines).repeat(8, axis=0).repeat(8, axis=1).astype(np.uint8)
    text, _, _ = cv2.QRCodeDetector().detectAndDecode(picture)
    assert text == url
