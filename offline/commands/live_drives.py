"""The `live` command: maps of drives under way, and at the end the map of the whole drives."""

import json
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from groundsbot.calib.foundation import atomic_write, folder_written_whole
from groundsbot.calib.robot import read_noise_yaml
from groundsbot.calib.web import Endpoint, open_page
from groundsbot.offline.commands.compilation import compile_solver
from groundsbot.offline.commands.map_drives import MapOptions, make_map
from groundsbot.offline.commands.shared import check_output, echo_line, read_robot_files
from groundsbot.offline.commands.terminal import echo_lines
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, announce_compilation, worker_processes
from groundsbot.offline.live import (
    LiveMap,
    NewestState,
    SceneServer,
    hints,
    parse_address,
    serve_page,
    serve_scenes,
    update_line,
)
from groundsbot.offline.maps import JSON_FILE, MapResult, map_as_json

_TOKEN_NAME: Final = ".live_token"


@dataclass(frozen=True)
class LiveOptions:
    """Options of the command line."""

    paths: Sequence[Path]
    output: Path
    robots: Sequence[Path] = ()
    noise: Path | None = None
    period_s: float = 1.0
    overwrite: bool = False
    workers: int | None = None
    page: str | None = None
    foxglove: str | None = None


class Clock(NamedTuple):
    """Time and pauses of the loop; viewers get the wall clock's."""

    now_s: Callable[[], float] = time.monotonic
    pause: Callable[[float], None] = time.sleep
    wall_ns: Callable[[], int] = time.time_ns


def follow(options: LiveOptions, clock: Clock = Clock()) -> MapResult:
    """Map runs until their recorders have finished them, then write the map of the whole drives.

    Returns:
        That map.

    Raises:
        GroundsbotError: one line that says what is wrong with an option, or why there is no map at the end.
    """
    check_output(options.output, options.paths, JSON_FILE, overwrite=options.overwrite)
    robot_files = read_robot_files(options.robots)
    noise = read_noise_yaml(options.noise) if options.noise else None
    interim = _InterimMap(options.output, overwrite=options.overwrite)
    endpoint = None if options.page is None else _open_page(options.page, options.output)
    with ExitStack() as stack:
        stack.enter_context(announce_compilation(echo_line))
        compile_solver(Stages())
        state = None
        if endpoint is not None:
            state = stack.enter_context(serve_page(endpoint))
        scenes = stack.enter_context(serve_scenes(options.foxglove))
        workers = stack.enter_context(worker_processes(1))
        live = LiveMap(options.paths, robot_files, noise, workers)
        _follow(live, _MapOutputs(interim, state, scenes), options.period_s, clock)
        workers.close(at_once=True)  # a fit under way is not needed any more
    whole = MapOptions(
        options.paths,
        options.output,
        options.robots,
        options.noise,
        overwrite=options.overwrite or interim.is_there,
        workers=options.workers,
    )
    return make_map(whole)[0]


class _MapOutputs(NamedTuple):
    """Where each update goes: map.json, and the page and viewers if they were asked for."""

    interim: "_InterimMap"
    page: NewestState | None
    scenes: SceneServer | None


def _open_page(text: str, output: Path) -> Endpoint:
    """Listen at the address of the page, and print its URLs."""
    address = parse_address(text, "--page")
    # Not in the map's folder, which is replaced.
    kept = output.absolute().with_name(_TOKEN_NAME)
    return open_page(address, kept, "laptop", lambda line: echo_lines([line]), qr=sys.stdout.isatty())


def _follow(live: LiveMap, outputs: _MapOutputs, period_s: float, clock: Clock) -> None:
    """Update the map until all runs are finished; lines and hints are printed when they change."""
    hinted: list[str] = []
    printed = ""
    while True:
        began_s = clock.now_s()
        update = live.update()
        document = None if update.result is None else map_as_json(update.result)
        if document is not None and update.is_new:
            outputs.interim.write(document)
            if outputs.scenes is not None and update.result is not None:
                outputs.scenes.show_map(update.result, clock.wall_ns())
        took_s = clock.now_s() - began_s
        line, found = update_line(update, document, took_s, period_s), hints(update, document)
        # The time that an update takes changes although nothing was driven.
        is_same = line.rpartition("; ")[0] == printed.rpartition("; ")[0]
        echo_lines([*([] if is_same else [line]), *(each for each in found if _topic(each) not in hinted)])
        printed = line
        hinted = [_topic(each) for each in found]
        if outputs.page is not None:
            outputs.page.show(update, document, line, found)
        if update.is_finished:
            return
        clock.pause(max(0.0, period_s - took_s))


def _topic(hint: str) -> str:
    """Return the part of a hint that stays while only its figures change."""
    return hint.partition(" would ")[0]


class _InterimMap:
    """map.json of the drives up to now, alone in its folder.

    Attributes:
        is_there: whether it was written.
    """

    def __init__(self, folder: Path, *, overwrite: bool) -> None:
        self.is_there = False
        self._folder = folder
        self._overwrite = overwrite

    def write(self, document: dict[str, Any]) -> None:
        """Write map.json; the first time, what was in the folder before is removed.

        Raises:
            GroundsbotError: it cannot be written.
        """
        text = json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
        if not self.is_there:
            with folder_written_whole(self._folder, replace=self._overwrite) as partial:
                (partial / JSON_FILE).write_text(text, encoding="utf-8")
            self.is_there = True
            return
        try:
            with atomic_write(self._folder / JSON_FILE, durable=False) as file:
                file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise OfflineError(
                f"-o {self._folder}: cannot be written ({error.strerror}); is the disk full, or the folder gone?"
            ) from error
