"""What several tests of self-calibration share."""

from pathlib import Path

import pytest

from tests.offline.self_calibration.calibrated_drives import LEGS, drive_legs


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    return drive_legs(folder, "a", LEGS)
