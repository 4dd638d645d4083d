"""Messages to systemd."""

import socket
from pathlib import Path

import pytest

from groundsbot.onboard.process.systemd import Notifier


def test_a_text_is_one_message_whatever_is_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each line of a notification is an assignment; names of files may have more than one."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        notifier = Notifier()
        notifier.notify_trouble("a\nMAINPID=1\x1b[2J")
        notifier.alive("b\nc")
        assert listener.recv(1000) == b"STATUS=a MAINPID=1\\x1b[2J"
        assert listener.recv(1000) == b"WATCHDOG=1\nSTATUS=b c"
