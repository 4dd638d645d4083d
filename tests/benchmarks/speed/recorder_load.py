"""The recorder under load: what is lost, how late, and what it costs, from a pseudo terminal and a folder of pictures.

    python -m tests.benchmarks.speed.recorder_load [--seconds 60] [--table] [--cameras 2] [--width-px 1280] [--gyro]
        [--page-clients N] [--viewer]

One run is 1 kHz of wheel lines and 30 pictures a second of 1280x720 with six tags, all pictures kept as they come.
`--cameras 2` has two cameras, each with pictures of that size at that rate; `--width-px` makes them smaller. `--gyro`
adds 1 kHz of a gyro, in lines of twenty samples. `--table` runs other sizes, rates and both detectors too, a shorter
time each. `--page-clients` serves the page to as many clients, each of which asks for every picture, as a browser does.
`--viewer` has a client of Foxglove's protocol take all topics. The processes of devices and clients are not counted.
Results go to build/benchmarks/recorder_load.jsonl.
"""

import argparse
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from groundsbot.calib.camera.file import write_camera_yaml
from groundsbot.calib.camera.model import CameraModel
from groundsbot.onboard.log.messages import Gyro, TagDetections, WheelEncoders, camera_topic
from groundsbot.onboard.log.reading.reader import find_logs, read_log
from tests.benchmarks.speed.recorder_devices import BATCH, START_S, Load, show_pictures, speak, view_topics, watch_page
from tests.support.data.logs import run_info_of
from tests.support.hostile.page_attacks import free_port

OUTPUT: Final = Path("build/benchmarks/recorder_load.jsonl")
_WARM_UP_S: Final = 5.0  # of the clock mapping
_PAGE_NICE: Final = 15
_TICKS_HZ: Final = os.sysconf("SC_CLK_TCK")
_ROWS: Final = (  # lines and pictures a second, size, pictures kept
    (100.0, 15.0, 640, 480, False),
    (100.0, 15.0, 640, 480, True),
    (100.0, 15.0, 1280, 720, False),
    (100.0, 15.0, 1280, 720, True),
    (100.0, 30.0, 1280, 720, True),
    (1000.0, 30.0, 1280, 720, True),
    (100.0, 15.0, 1920, 1080, True),
)


def table(seconds: float) -> list[Load]:
    """Loads for the page about the recorder."""
    return [
        Load(seconds, lines_hz, fps, width_px, height_px, detector, keep)
        for lines_hz, fps, width_px, height_px, keep in _ROWS
        for detector in ("pupil-apriltags", "pyapriltags")
    ]


def _robot(load: Load, folder: Path) -> Path:
    model = CameraModel("front", load.width_px, load.height_px, 900.0, 900.0, 639.5, 359.5, "plumb_bob", (0.0,) * 5)
    write_camera_yaml(model, folder / "camera.yaml")
    path = folder / "robot.yaml"
    device = [f"{{camera: pictures{each}, camera_fps: {load.fps}}}" for each in range(load.cameras)]
    port = f"encoder_port: {folder / 'wheels'}, encoder_baud: 921600"
    cameras = f"camera: camera.yaml\ndevices: {{{port}, {device[0][1:]}"
    if load.cameras > 1:
        sections = [
            f"{name}: {{camera: camera.yaml, device: {device[each]}}}" for each, name in enumerate(_names(load))
        ]
        cameras = f"devices: {{{port}}}\ncameras: {{{', '.join(sections)}}}"
    path.write_text(f"""
robot_id: load
wheels: {{radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.3, ticks_per_turn: 1024}}
{cameras}
recorder: {{picture_rate_hz: {load.fps if load.keep else 0.0}, detector: {load.detector}, quad_decimate: 2.0}}
""")
    return path


def _names(load: Load) -> list[str]:
    return [f"camera{each}" for each in range(load.cameras)] if load.cameras > 1 else [""]


def processes_of(pid: int) -> Iterator[int]:
    yield pid
    for task in Path(f"/proc/{pid}/task").iterdir():
        children = ""
        with suppress(OSError):  # a thread that has just ended
            children = (task / "children").read_text()
        for child in children.split():
            yield from processes_of(int(child))


def cpu_s_of(pid: int) -> dict[int, float]:
    """Seconds of CPU that the process and each below it have had."""
    used = {}
    for each in processes_of(pid):
        fields = Path(f"/proc/{each}/stat").read_text().rpartition(") ")[2].split()
        used[each] = (int(fields[11]) + int(fields[12])) / _TICKS_HZ
    return used


def _is_page(pid: int) -> bool:
    """Whether it is the page's process, which alone has so low a priority."""
    return os.getpriority(os.PRIO_PROCESS, pid) >= _PAGE_NICE


def memory_mb_of(pid: int) -> float:
    """What the processes have for themselves, and their shares of what they have in common."""
    total_kb = 0
    for each in processes_of(pid):
        lines = Path(f"/proc/{each}/smaps_rollup").read_text().splitlines()
        total_kb += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total_kb / 1000


def _command(load: Load, folder: Path) -> list[str]:
    command = [sys.executable, "-m", "groundsbot.onboard.cli", "record", "--robot", str(_robot(load, folder))]
    if load.page_clients is not None:
        command += ["--page", str(free_port())]
    if load.viewer:
        command += ["--foxglove", str(free_port())]
    return [*command, "--output", str(folder / "logs")]


def run(load: Load, folder: Path) -> dict[str, Any]:
    """Records once; returns what came of it."""
    context = multiprocessing.get_context("spawn")
    clients = {what: context.Queue() for what in ("page", "foxglove")}
    go, over, answers = context.Event(), context.Event(), (context.Queue(), context.Queue())
    devices = [
        context.Process(target=target, args=(load, folder, go, answer, over), daemon=True)
        for target, answer in zip((speak, show_pictures), answers, strict=True)
    ]
    for each in devices:
        each.start()
    with subprocess.Popen(_command(load, folder), stdout=subprocess.PIPE, text=True) as recorder:
        try:
            assert recorder.stdout is not None
            waited_for = ["port_connected"] + ["camera_connected"] * load.cameras
            while waited_for:
                line = recorder.stdout.readline()
                kind = line.partition(":")[0]
                if kind in waited_for:
                    waited_for.remove(kind)
                what, _, url = line.partition(": ")
                client = {"page": watch_page, "foxglove": view_topics}.get(what)
                if client is not None:
                    arguments = (url.strip(), load.page_clients, clients[what], over)
                    context.Process(target=client, args=arguments, daemon=True).start()
            time.sleep(START_S)  # what starts is not counted
            before, start_s = cpu_s_of(recorder.pid), time.monotonic()
            go.set()
            time.sleep(load.seconds)
            after, end_s = cpu_s_of(recorder.pid), time.monotonic()
            memory_mb = memory_mb_of(recorder.pid)
            pages = {pid for pid in after if _is_page(pid)}
            (measured_ns, refused), n_shown = (answer.get() for answer in answers)
            time.sleep(0.5)
            recorder.send_signal(signal.SIGTERM)
            said = recorder.communicate()[0]
        except BaseException:
            recorder.kill()  # else nothing would end it
            raise
        finally:
            over.set()
    shares = {pid: (after[pid] - before.get(pid, 0.0)) / (end_s - start_s) for pid in after}
    own = shares.pop(recorder.pid)
    page = sum(share for pid, share in shares.items() if pid in pages)
    found = {
        **asdict(load),
        "exit_code": recorder.returncode,
        "cpu_recorder": round(own, 3),
        "cpu_detection": round(sum(shares.values()) - page, 3),
        "cpu_page": round(page, 3),
        "cpu_total": round(own + sum(shares.values()), 3),
        "memory_mb": round(memory_mb),
        "refused_bytes": refused,
        **_judge(folder / "logs", measured_ns, n_shown, load),
    }
    if load.page_clients:
        found["pictures_watched"] = clients["page"].get()
    if load.viewer:
        found["viewed_mb"] = round(clients["foxglove"].get() / 1e6, 1)
    if recorder.returncode:
        found["said"] = said[-400:]
    return found


def _judge(logs: Path, measured_ns: list[int], n_shown: list[int], load: Load) -> dict[str, Any]:
    (log,) = find_logs([logs])
    epoch_ns = run_info_of(log).run_epoch_ns
    wheels = [each.message for each in read_log(log, ["/wheels"]) if isinstance(each.message, WheelEncoders)]
    frames = list(read_log(log, ["/tags/detections"]))
    kept = [each.topic for each in read_log(log, ["/camera/image"])] if load.keep else []
    by_camera = list(zip(_names(load), n_shown, strict=True))
    n_tags = [len(each.message.detections) for each in frames if isinstance(each.message, TagDetections)]
    undetected = [
        n - sum(each.topic == camera_topic("/tags/detections", name) for each in frames) for name, n in by_camera
    ]
    not_kept = [n - kept.count(camera_topic("/camera/image", name)) if load.keep else 0 for name, n in by_camera]
    samples = [each.message.sequence for each in read_log(log, ["/gyro"]) if isinstance(each.message, Gyro)]
    n_samples = len(measured_ns) // BATCH * BATCH if load.gyro else 0
    warm = round(_WARM_UP_S * load.lines_hz)
    measured = np.array([measured_ns[each.sequence] for each in wheels])
    # The least delay of a link cannot be seen from one end: here it is none, so nothing is taken out.
    error_ms = np.abs(np.array([each.stamp_ns for each in wheels]) - epoch_ns - measured)[warm:] / 1e6
    size = sum(each.stat().st_size for each in logs.rglob("*.mcap"))
    return {
        "lines_sent": len(measured_ns),
        "lines_lost": len(measured_ns) - len({each.sequence for each in wheels}),
        "samples_sent": n_samples,
        "samples_lost": n_samples - len(set(samples)),
        "pictures_shown": sum(n_shown),
        "pictures_undetected": sum(undetected),
        "pictures_not_kept": sum(not_kept),
        **({"undetected_by_camera": undetected, "not_kept_by_camera": not_kept} if load.cameras > 1 else {}),
        "tags_per_picture": round(float(np.mean(n_tags)), 2),
        "stamp_error_p99_ms": round(float(np.quantile(error_ms, 0.99)), 3),
        "stamp_error_max_ms": round(float(error_ms.max()), 3),
        "mb_per_hour": round(size / load.seconds * 3600 / 1e6),
    }


def main() -> int:
    """Runs what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--cameras", type=int, default=1)
    parser.add_argument("--gyro", action="store_true")
    parser.add_argument("--width-px", type=int, default=1280, help="of pictures of 16:9")
    parser.add_argument("--page-clients", type=int)
    parser.add_argument("--viewer", action="store_true")
    arguments = parser.parse_args()
    one = Load(
        arguments.seconds,
        width_px=arguments.width_px,
        height_px=round(arguments.width_px * 9 / 16),
        cameras=arguments.cameras,
        gyro=arguments.gyro,
        page_clients=arguments.page_clients,
        viewer=arguments.viewer,
    )
    loads = table(arguments.seconds) if arguments.table else [one]
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    for load in loads:
        with tempfile.TemporaryDirectory(prefix="recorder_load_") as folder:
            found = run(load, Path(folder))
        with OUTPUT.open("a") as file:
            file.write(json.dumps(found) + "\n")
        sys.stdout.write(json.dumps(found) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
