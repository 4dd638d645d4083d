"""Options and arguments that several commands of `groundsbot-offline` have, and the logs that the latter mean."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.maps import JSON_FILE, MapModel

JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
MODELS: Final = "|".join(MapModel)
LogArguments = Annotated[
    list[Path], typer.Argument(metavar="LOG...", help="Log files, run folders or folders of runs.")
]


def parse_model(text: str) -> MapModel:
    """Parse --model.

    Raises:
        BadParameter: it is none.
    """
    if text not in set(MapModel):
        raise typer.BadParameter(
            f"{text!r} is none of {MapModel.FLOOR} (tags' positions on the floor) and {MapModel.CORNERS} (tags' "
            "corners in pixels, which give tags' heights and attitudes too)"
        )
    return MapModel(text)


def logs_of(paths: Sequence[Path]) -> list[Path]:
    """Return the logs of LOG arguments.

    Raises:
        GroundsbotError: a path is missing or holds no log, or is or holds a map.
    """
    from groundsbot.onboard.log import find_logs

    for path in paths:
        _check_no_map(path)
    logs = find_logs(paths)
    for log in logs:
        _check_no_map(log)
    return logs


def log_of(path: Path) -> Path:
    """Return the log of a LOG argument for one run.

    Raises:
        GroundsbotError: as `logs_of`, or there are several runs.
    """
    logs = logs_of([path])
    if len(logs) > 1:
        raise OfflineError(f"{path}: holds {len(logs)} runs; give one of them, as {logs[0]}")
    return logs[0]


def _check_no_map(path: Path) -> None:
    """Refuse the folder of a map, and its map.mcap or map.json."""
    marker = path / JSON_FILE if path.is_dir() else path.with_name(JSON_FILE)
    if marker.is_file() and (path.is_dir() or path.stem == marker.stem):
        raise OfflineError(f"{path}: is a map, not a log; give the logs of drives, as recorded or imported")
