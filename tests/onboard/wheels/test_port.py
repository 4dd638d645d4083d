"""The serial port on a pseudo terminal."""

import errno
import gc
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from groundsbot.fixtures.recording.devices import PtyPort
from groundsbot.onboard.wheels.port import EncoderPort, PortLostError


def test_a_port_that_a_recorder_reads_is_reported_as_in_use(tmp_path: Path, plug_in: Callable[..., PtyPort]) -> None:
    plug_in(tmp_path / "wheels", patient=True)
    path = str(tmp_path / "wheels")
    first, second = EncoderPort(path, 115200), EncoderPort(path, 115200)
    first.open()
    with pytest.raises(PortLostError, match="wheels at 115200 baud cannot be opened: another program has it"):
        second.open()
    first.close()
    second.open()
    second.close()


def test_a_port_whose_closing_fails_is_not_closed_again_when_it_is_collected(
    tmp_path: Path, plug_in: Callable[..., PtyPort], monkeypatch: pytest.MonkeyPatch
) -> None:
    plug_in(tmp_path / "wheels")
    port, really = EncoderPort(str(tmp_path / "wheels"), 115200), os.close
    port.open()
    closed: list[int] = []

    def close(file: int) -> None:
        closed.append(file)
        really(file)
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "close", close)
    port.close()
    gc.collect()
    assert len(closed) == 1  # a second time it may be another file's number


def test_a_port_can_be_unplugged_twice_and_takes_no_more_lines(tmp_path: Path) -> None:
    port = PtyPort(tmp_path / "wheels", patient=True)
    port.unplug()
    with (tmp_path / "other").open("w+") as other:  # has the port's number
        port.unplug()
        assert not port.send(b"a line\n")
        assert other.read() == ""
    assert port.refused == 7
