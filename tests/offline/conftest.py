"""Drives that tests of several rooms share."""

from pathlib import Path

import pytest

from groundsbot.fixtures.simulate import simulate


@pytest.fixture(scope="session")
def two_camera_drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with unrendered drives of robots that have a camera ahead and one to the left, and their truth."""
    made = tmp_path_factory.mktemp("drives") / "room"
    simulate("room", 3, made, render=False, two_cameras=True)
    return made
