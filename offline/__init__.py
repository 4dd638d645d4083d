"""What runs on the laptop: run logs in, one map of all tags and trajectories out.

As a library (docs/library.md): the names below, each loaded when it is first asked for, so that `-h` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from calib.errors import GroundsbotError
    from calib.noise import NoiseParameters
    from offline.bag_import import import_bag
    from offline.bag_topics import BagOptions
    from offline.chain import chains_of
    from offline.import_robot import ImportOptions
    from offline.importers import import_folder
    from offline.localization import Localization
    from offline.localizing import localize
    from offline.map_io import read_map, write_map
    from offline.online_drive import TagReading
    from offline.online_localizer import OnlineLocalizer, OnlinePose
    from offline.pipeline import build_map
    from offline.result import Component, MapResult, RunResult, TagResult
    from offline.run import Run, load_run, read_robot_file
    from onboard.log_reader import find_logs

__all__ = [
    "BagOptions",
    "Component",
    "GroundsbotError",
    "ImportOptions",
    "Localization",
    "MapResult",
    "NoiseParameters",
    "OnlineLocalizer",
    "OnlinePose",
    "Run",
    "RunResult",
    "TagReading",
    "TagResult",
    "build_map",
    "chains_of",
    "find_logs",
    "import_bag",
    "import_folder",
    "load_run",
    "localize",
    "read_map",
    "read_robot_file",
    "write_map",
]

_HOMES: Final = {
    "BagOptions": "offline.bag_topics",
    "Component": "offline.result",
    "GroundsbotError": "calib.errors",
    "ImportOptions": "offline.import_robot",
    "Localization": "offline.localization",
    "MapResult": "offline.result",
    "NoiseParameters": "calib.noise",
    "OnlineLocalizer": "offline.online_localizer",
    "OnlinePose": "offline.online_localizer",
    "Run": "offline.run",
    "RunResult": "offline.result",
    "TagReading": "offline.online_drive",
    "TagResult": "offline.result",
    "build_map": "offline.pipeline",
    "chains_of": "offline.chain",
    "find_logs": "onboard.log_reader",
    "import_bag": "offline.bag_import",
    "import_folder": "offline.importers",
    "load_run": "offline.run",
    "localize": "offline.localizing",
    "read_map": "offline.map_io",
    "read_robot_file": "offline.run",
    "write_map": "offline.map_io",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - types are told above
    """A name of the library, from where it lives.

    Raises:
        AttributeError: it has none of that name.
    """
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
