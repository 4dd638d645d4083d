"""The `live` command with a finished map: poses of robots under way, as lines of JSON."""

import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from groundsbot.offline.commands.shared import echo_line, read_robot_files
from groundsbot.offline.commands.terminal import echo_lines
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import announce_compilation
from groundsbot.offline.live import (
    LineServer,
    RunLocalizer,
    SceneServer,
    StampedPose,
    TopicFeed,
    is_address,
    parse_port,
    serve_lines,
    serve_scenes,
)
from groundsbot.offline.maps import JSON_FILE, read_map
from groundsbot.offline.measurements import MEASURED_TOPICS, GrowingRun, MessageSource

_POLL_S: Final = 0.05  # between looks at the logs, to which recorders write twice a second
_LEAST_PERIOD_S: Final = 0.005  # between poses made from live topics


@dataclass(frozen=True)
class PosesOptions:
    """Options of the command line."""

    runs: Sequence[str]  # paths, or addresses of live topics
    map: Path
    robots: Sequence[Path] = ()
    period_s: float = 1.0
    poses: str | None = None
    foxglove: str | None = None


class PosesClock(NamedTuple):
    """Time and pauses of the loop; ages are by the wall clock."""

    now_s: Callable[[], float] = time.monotonic
    wall_ns: Callable[[], int] = time.time_ns
    pause: Callable[[float], None] = time.sleep


def follow_poses(options: PosesOptions, clock: PosesClock = PosesClock()) -> None:
    """Localize robots in a map until the recorders have finished their runs; write poses to a socket if asked for.

    Raises:
        GroundsbotError: one line that says what is wrong with an option, with the map, or with all runs.
    """
    robot_files = read_robot_files(options.robots)
    known = read_map(options.map.parent if options.map.name == JSON_FILE else options.map)
    with announce_compilation(echo_line), ExitStack() as stack:
        outputs = _PoseOutputs(_serve_poses(options, stack), stack.enter_context(serve_scenes(options.foxglove)))
        if outputs.scenes is not None:
            outputs.scenes.show_map(known, clock.wall_ns())
        arrived = threading.Event()
        sources = [_source(each, arrived) for each in options.runs]
        localizers = [RunLocalizer(GrowingRun(each, robot_files), known) for each in sources]
        newest: dict[int, StampedPose] = {}
        troubles: list[str] = []
        printed_s = clock.now_s()
        while True:
            begun_s = clock.now_s()
            for index, each in enumerate(localizers):
                found = each.advance()
                if found:
                    newest[index] = found[-1]
                outputs.send(found, clock)
            is_finished = all(each.is_finished for each in localizers)
            if is_finished or clock.now_s() - printed_s >= options.period_s:
                printed_s = clock.now_s()
                before, troubles = troubles, [each.trouble for each in localizers if each.trouble]
                if is_finished and not newest:
                    raise OfflineError("; ".join(troubles) or "no run has wheel readings, so there are no poses")
                echo_lines([each for each in troubles if each not in before])
                echo_lines([pose_line(pose, clock.wall_ns()) for pose in newest.values()])
            if is_finished:
                return
            if any(map(is_address, options.runs)):
                clock.pause(max(0.0, begun_s + _LEAST_PERIOD_S - clock.now_s()))
                arrived.wait(_POLL_S)
                arrived.clear()
            else:
                clock.pause(_POLL_S)


class _PoseOutputs(NamedTuple):
    """Where all poses go, if these were asked for."""

    lines: LineServer | None
    scenes: SceneServer | None

    def send(self, found: Sequence[StampedPose], clock: PosesClock) -> None:
        if self.scenes is not None:
            self.scenes.show_poses(found)
        if self.lines is not None:
            self.lines.write([pose_json(pose, clock.wall_ns()) for pose in found])


def _serve_poses(options: PosesOptions, stack: ExitStack) -> LineServer | None:
    if options.poses is None:
        return None
    server = stack.enter_context(serve_lines(parse_port(options.poses, "--poses"), "--poses"))
    echo_lines([f"poses: port {server.port} of this computer"])
    return server


def _source(run: str, arrived: threading.Event) -> Path | MessageSource:
    """Return where the messages of a run come from; the event is set when some have come."""
    return TopicFeed(run, MEASURED_TOPICS, arrived) if is_address(run) else Path(run)


def pose_json(pose: StampedPose, now_ns: int) -> str:
    """Return a pose, and its age at a time of the wall clock, as a line of JSON."""
    record: dict[str, object] = {"run": pose.run, "stamp_ns": pose.stamp_ns, "age_s": _age_s(pose, now_ns)}
    if pose.pose is None:
        record["reason"] = pose.reason
    else:
        names = ("x_m", "y_m", "theta_rad")
        record |= dict(zip(names, pose.pose.T_map_base.tolist(), strict=True))
        record["covariance"] = pose.pose.covariance.tolist()
    return json.dumps(record, allow_nan=False)


def pose_line(pose: StampedPose, now_ns: int) -> str:
    """Return a pose and its age in words."""
    age = f"{_age_s(pose, now_ns):.2f} s old"
    if pose.pose is None:
        return f"{pose.run}: not located: {pose.reason}; {age}"
    x_m, y_m, theta_rad = pose.pose.T_map_base
    sigma_x_m, sigma_y_m, sigma_rad = np.sqrt(np.diag(pose.pose.covariance))
    return (
        f"{pose.run}: x {x_m:.3f} m, y {y_m:.3f} m, {degrees(theta_rad):.2f} deg (sigma {sigma_x_m:.3f} m, "
        f"{sigma_y_m:.3f} m, {degrees(sigma_rad):.2f} deg); {age}"
    )


def _age_s(pose: StampedPose, now_ns: int) -> float:
    return round((now_ns - pose.stamp_ns) * 1e-9, 6)
