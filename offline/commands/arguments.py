"""Options and arguments that several commands of `groundsbot-offline` have, and the logs and workers that they mean."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final

import typer

from groundsbot.calib.web import require_libraries
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import (
    RemoteLog,
    Workers,
    default_workers,
    find_remote_logs,
    log_path,
    log_size,
    worker_processes,
)
from groundsbot.offline.maps import JSON_FILE, MapModel

JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
_OF_DRIVES: Final = "groundsbot.offline.mapping.pipeline"  # imports all that workers do with drives
MODELS: Final = "|".join(MapModel)
LogArguments = Annotated[
    list[Path], typer.Argument(metavar="LOG...", help="Log files, run folders or folders of runs.")
]

DriveArguments = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...",
        help="Log files, run folders or folders of runs; or such at a URL: s3://, gs://, https:// or what else fsspec "
        "opens (docs/cluster.md).",
        parser=log_path,
    ),
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
    logs: list[Path] = []
    for path in paths:
        logs += find_remote_logs(path) if isinstance(path, RemoteLog) else find_logs(path)
    for log in logs:
        _check_no_map(log)
    return logs


@contextmanager
def workers_for(logs: Sequence[Path], scheduler: str | None, n: int | None) -> Iterator[Workers]:
    """Yield the workers of a command that takes drives; they load what mapping needs at once, beside this process.

    Args:
        logs: the drives.
        scheduler: scheduler of a Dask cluster; None: processes on this computer.
        n: number of processes; None: as many as are of use.

    Raises:
        OfflineError: both are given, or the cluster cannot be used.
    """
    if scheduler is None:
        with worker_processes(n or default_workers([log_size(log) for log in logs])) as workers:
            workers.load_ahead(_OF_DRIVES, len(logs))
            yield workers
        return
    if n is not None:
        raise OfflineError(
            f"--scheduler {scheduler}: the cluster has workers of its own; leave --workers {n} out, or --scheduler"
        )
    require_libraries(f"--scheduler {scheduler}", ("distributed",), "cluster")
    from groundsbot.offline.foundation import cluster_workers

    with cluster_workers(scheduler) as workers:
        yield workers


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
