"""Does this checkout do what another revision did? Both run on the same inputs, and all files are compared.

    python -m tests.benchmarks.same_results REVISION [--relative 1e-9] [--keep FOLDER]

Both are built as wheels and installed in folders of their own. What the simulator writes is compared first; then each
command runs with both on what REVISION simulated, on the paper's recordings (where they are in ../shared/data) and on a
ROS bag. Compared are all files byte for byte, what is printed (but how long it took), and exit codes. Exits with 1
where anything differs; with `--relative`, numbers in text, .npz and .mcap files may differ by so much.
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from groundsbot.calib.foundation.command_line import EXIT_DONE, EXIT_WITH_LOSSES
from tests.benchmarks.command_line import say
from tests.support.data.importing.bags import BagOfLog
from tests.support.installed import checkout_sources, install, revision_sources
from tests.support.paper_recordings import RECORDINGS

# Run with both, compared, and REVISION's are what all below is run on.
INPUTS: Final = """
fixtures demo --output demo
fixtures simulate --world nsh --seed 1 --no-render --output nsh
fixtures simulate --world room --seed 0 --no-render --output room
"""
COMMANDS: Final = """
calib board -o board.pdf
calib tags --ids 0-5 --size-mm 100 -o tags.pdf
offline info INPUTS/nsh --json
offline map INPUTS/demo/logs -o demo --json
offline map INPUTS/demo/logs -o demo_corners --model corners
offline map INPUTS/nsh -o nsh --calibrate auto
offline map INPUTS/room -o room --model corners
offline map INPUTS/nsh/FIRST -o first
offline localize INPUTS/nsh/SECOND --map first -o second_in_first
offline map --extend first/map.json INPUTS/nsh/SECOND -o extended
offline calibrate INPUTS/room -o calibrated
offline map INPUTS/room -o given --noise INPUTS/noise.yaml --keep-suspects --distance a_seed0,b_seed0=3,9
offline map INPUTS/room -o recalibrated --robot calibrated/a.yaml --robot calibrated/b.yaml --robot calibrated/c.yaml
offline import INPUTS/folder -o from_folder --track-width-m 0.3
offline map from_folder -o folder_map
offline compare demo --truth INPUTS/demo/logs/truth.json --json
offline compare room --truth INPUTS/room/truth.json
offline compare demo --survey first/tags.csv
offline export demo --format g2o -o demo.g2o
offline export demo --format tum -o trajectories
offline export demo --format csv -o demo.csv
offline export demo --format geojson --origin 48.2,11.6,90 -o demo.geojson
offline export room --format frc --field-m 6,4 --frame INPUTS/field.csv -o layout.json
offline export demo_corners --format limelight -o layout.fmap
offline import INPUTS/drive -o from_bag --tag-size-m 0.16
offline map from_bag -o bag_map
offline salvage INPUTS/cut.mcap -o salvaged.mcap
offline detect INPUTS/demo/logs/DRIVE -o detected
"""
PAPER: Final = """
offline import RECORDINGS/hallway -o paper --state-rate-hz 4.2 --track-width-m 0.508
offline import RECORDINGS/loop -o paper --state-rate-hz 4.2 --track-width-m 0.508
offline map paper -o paper_map
"""
_NUMBER: Final = re.compile(r"[-+]?(?:\d+\.\d*(?:[eE][-+]?\d+)?|\d+[eE][-+]?\d+)")
DONE: Final = (f"exit {EXIT_DONE}", f"exit {EXIT_WITH_LOSSES}")


class Side(NamedTuple):
    """One of the two that are compared: where it is installed, and the folder that it works in."""

    installed: Path
    folder: Path

    def run(self, commands: Sequence[str]) -> None:
        """Runs commands one after the other; what each prints and its exit code become a file of the folder."""
        prefix = "groundsbot." if (self.installed / "groundsbot").is_dir() else ""
        for i, command in enumerate(commands):
            program, *words = shlex.split(command)
            module = f"{prefix}{program}" if program == "fixtures" else f"{prefix}{program}.cli"
            done = subprocess.run(
                [sys.executable, "-m", module, *words],
                cwd=self.folder,
                env={**os.environ, "PYTHONPATH": str(self.installed), "COLUMNS": "120"},
                capture_output=True,
                text=True,
                check=False,
            )
            told = f"{command}\nexit {done.returncode}\n" + _without_times(done.stdout + done.stderr)
            (self.folder / f"{i:02}-{program}.printed").write_text(told, encoding="utf-8")


def main() -> int:
    """Prints what differs; 1 if anything does."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", help="as git names it")
    parser.add_argument("--relative", type=float, default=0.0, help="how far numbers may differ")
    parser.add_argument("--keep", type=Path, help="new folder for all files of both")
    arguments = parser.parse_args()
    if arguments.keep and arguments.keep.exists():
        parser.error(f"--keep {arguments.keep}: exists already; name a new folder")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sources = revision_sources(arguments.revision, folder / "old"), checkout_sources(folder / "new")
        installed = [install(each, folder / "installed" / each.name) for each in sources]
        n_different = _compare(installed, folder, arguments.relative)
        if arguments.keep:
            shutil.copytree(folder, arguments.keep, symlinks=True)
    return int(n_different > 0)


def _compare(installed: Sequence[Path], folder: Path, relative: float) -> int:
    made = _run_both(installed, folder / "inputs", INPUTS)
    n_different = report(made, relative)
    inputs = made[0].folder
    _add_inputs(inputs)
    robots = sorted(path.name for path in (inputs / "nsh").iterdir() if path.is_dir())
    commands = COMMANDS.rstrip() + (PAPER if RECORDINGS.is_dir() else "")
    words = {
        "INPUTS": str(inputs),
        "FIRST": robots[0],
        "SECOND": robots[1],
        "DRIVE": _first_run(inputs / "demo" / "logs"),
        "RECORDINGS": str(RECORDINGS),
    }
    for word, value in words.items():
        commands = commands.replace(word, value)
    if not RECORDINGS.is_dir():
        say("the paper's recordings are not in ../shared/data: left out")
    return n_different + report(_run_both(installed, folder / "results", commands), relative)


def _add_inputs(inputs: Path) -> None:
    """A bag of a simulated drive, a log that ends in the middle, a drive as CSV files, a noise file, and two tags."""
    log = inputs / "room" / _first_run(inputs / "room")
    BagOfLog.of(log).odometry().mount().camera_info().apriltag_msgs().write(inputs / "drive")
    whole = next(log.glob("*.core.mcap")).read_bytes()
    (inputs / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    folder = inputs / "folder"
    folder.mkdir()
    turning = "".join(f"{0.1 * i:.1f},0.5,0.1\n" for i in range(100))
    seen = "".join(f"{0.1 * i:.1f},{i // 3 % 3},{3.0 - 0.03 * i:.2f},{0.5 * (i // 3 % 3)}\n" for i in range(0, 100, 3))
    (folder / "odometry.csv").write_text("t_s,v_m_s,omega_rad_s\n" + turning, encoding="utf-8")
    (folder / "observations.csv").write_text("t_s,tag_id,x_m,y_m\n" + seen, encoding="utf-8")
    (inputs / "noise.yaml").write_text("sigma_corner_px: 0.3\n", encoding="utf-8")
    (inputs / "field.csv").write_text("tag_id,x_m,y_m\n0,5.998,1.3\n3,0.002,2.9\n", encoding="utf-8")


def _first_run(logs: Path) -> str:
    """ROBOT/RUN of the first one in a folder of logs."""
    return str(sorted(path.relative_to(logs) for path in logs.glob("*/*") if path.is_dir())[0])


def _run_both(installed: Sequence[Path], folder: Path, commands: str) -> list[Side]:
    sides = [Side(each, folder / each.name) for each in installed]
    for side in sides:
        side.folder.mkdir(parents=True)
    with ThreadPoolExecutor(len(sides)) as pool:
        list(pool.map(lambda side: side.run(commands.strip().splitlines()), sides))
    return sides


def report(sides: Sequence[Side], relative: float) -> int:
    """How many files differ by more than is allowed; says which, and how."""
    names = [{str(path.relative_to(side.folder)) for path in _files(side.folder)} for side in sides]
    n_different, n_same = len(names[0] ^ names[1]), 0
    for name in sorted(names[0] ^ names[1]):
        say(f"only in {'REVISION' if name in names[0] else 'the checkout'}: {name}")
    for name in sorted(names[0] & names[1]):
        old, new = (side.folder / name for side in sides)
        if old.read_bytes() == new.read_bytes():
            n_same += 1
            continue
        difference = relative_difference(old, new)
        n_different += relative == 0.0 or not difference <= relative
        say(f"differs: {name}, numbers by {difference:.1e} relative")
    failed = [line for path in sorted(sides[0].folder.glob("*.printed")) for line in _failure(path)]
    for line in failed:
        say(f"REVISION ends with {line}")
    say(f"{n_same} files are the same, {n_different} are not")
    return n_different + len(failed)


def relative_difference(old: Path, new: Path) -> float:
    """The largest of all numbers with a fraction, by the larger of the two; inf where anything else differs."""
    try:
        (before, old_numbers), (after, new_numbers) = (_split_numbers(path) for path in (old, new))
    except (UnicodeDecodeError, ValueError, McapError):
        return np.inf
    if before != after or len(old_numbers) != len(new_numbers):
        return np.inf
    a, b = np.array(old_numbers, dtype=np.float64), np.array(new_numbers, dtype=np.float64)
    largest = np.maximum(np.abs(a), np.abs(b))
    return float(np.max(np.abs(a - b) / np.where(largest > 0, largest, 1.0), initial=0.0))


def _split_numbers(path: Path) -> tuple[str, list[float]]:
    """A file's text, whole numbers (ids, counts, stamps) included, and its numbers with a fraction or an exponent."""
    if path.suffix == ".npz":
        return _arrays_parted(path)
    text = "\n".join(_messages(path)) if path.suffix == ".mcap" else path.read_text(encoding="utf-8")
    return _NUMBER.sub("#", text), [float(number) for number in _NUMBER.findall(text)]


def _arrays_parted(path: Path) -> tuple[str, list[float]]:
    told, numbers = [], list[float]()
    with np.load(path) as arrays:
        for name in arrays.files:
            array = arrays[name]
            is_number = np.isfinite(array) if array.dtype.kind == "f" else np.zeros(array.shape, dtype=np.bool_)
            numbers += array[is_number].tolist()
            told.append((name, array.dtype.str, array.shape, is_number.tolist(), array[~is_number].tolist()))
    return repr(told), numbers


def _messages(path: Path) -> Iterator[str]:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            yield f"{channel.topic} {message.log_time} {message.publish_time} {content}"


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def _failure(path: Path) -> list[str]:
    """The exit code and the command, where it did not do what it was to do."""
    command, code, *_ = path.read_text(encoding="utf-8").splitlines()
    return [] if code in DONE else [f"{code}: {command}"]


def _without_times(printed: str) -> str:
    """Without how long things took, and without the line on compiling, which is not there where a cache is."""
    lines = [line for line in printed.splitlines() if "compiling" not in line]
    return re.sub(r"\bin [\d.]+ s\b", "in # s", "\n".join(lines))


if __name__ == "__main__":
    sys.exit(main())
