"""The serial port on a pseudo terminal."""

from pathlib import Path

import pytest

from fixtures.devices import PtyPort
from onboard.encoder_port import EncoderPort, PortLostError


def test_a_port_that_a_recorder_reads_is_said_to_be_taken(tmp_path: Path) -> None:
    PtyPort(tmp_path / "wheels", patient=True)
    path = str(tmp_path / "wheels")
    first, second = EncoderPort(path, 115200), EncoderPort(path, 115200)
    first.open()
    with pytest.raises(PortLostError, match="wheels at 115200 baud cannot be opened: another program has it"):
        second.open()
    first.close()
    second.open()
    second.close()
