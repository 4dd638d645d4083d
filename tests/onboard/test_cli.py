"""groundsbot-onboard's options as a person writes them."""

from pathlib import Path

import pytest

from groundsbot.calib.errors import GroundsbotError
from groundsbot.onboard.cli import app


@pytest.mark.parametrize("command", ["record", "check", "capture"])
def test_output_has_the_short_name_of_the_other_programs(command: str, tmp_path: Path) -> None:
    with pytest.raises(GroundsbotError, match=r"no\.yaml: cannot be read"):
        app([command, "--robot", str(tmp_path / "no.yaml"), "-o", str(tmp_path / "out")], standalone_mode=False)
    assert not list(tmp_path.iterdir())
