"""A report of two drives, and a browser to look at it."""

from pathlib import Path

import pytest

from groundsbot.offline.commands.map_drives import MapOptions, make_map
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps.result import MapResult
from tests.support.data.drives import make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS

Inside = tuple[MapResult, Diagnostics]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="session")
def logs(folder: Path) -> list[Path]:
    return [
        write_drive(folder / "logs", drive, TAGS, make_robot(name), corner_sigma_px=0.3, seed=i)
        for i, (name, drive) in enumerate(DRIVES.items())
    ]


@pytest.fixture(scope="session")
def made(folder: Path, logs: list[Path]) -> Path:
    """What `map` writes."""
    make_map(MapOptions(logs, folder / "map"))
    return folder / "map"


@pytest.fixture(scope="session")
def inside(logs: list[Path]) -> Inside:
    workings = Diagnostics()
    return build_map(read_runs(logs), workings=workings), workings
