"""Files and folders of at most 1 MiB, other than logs, made to take memory and time.

Maps, drives to import, truths, surveys, robot.yaml and noise.
"""

import io
import json
import shutil
import sqlite3
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1

from groundsbot.offline.maps.files import ARRAYS_FILE, write_map
from groundsbot.offline.maps.model import JSON_FILE
from tests.support.data.importing.ros_messages import STORE1, STORE2, Sent, header, make_message, write_bag
from tests.support.data.maps import make_map
from tests.support.hostile.folders import FOLDERS, RUN_FOLDERS
from tests.support.hostile.logs import HOSTILE, yaml_bomb

_MIB = 1 << 20
_S = 1_000_000_000
_ODOMETRY = "nav_msgs/msg/Odometry"
_TAGS1 = "apriltag_ros/msg/AprilTagDetectionArray"
_TAGS2 = "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray"


def truth_and_survey(folder: Path) -> tuple[Path, Path]:
    """Of `make_map`."""
    runs = {"red_one": {"poses": [[1_800_000_000_000_000_000, 0.0, 0.0, 0.0]]}}
    truth, survey = folder / "truth.json", folder / "survey.csv"
    truth.write_text(json.dumps({"runs": runs, "tags": []}))
    survey.write_text("tag_id,x_m,y_m,family\n3,4,1,tag36h11\n7,6,-2,tag36h11\n3,9,5,tag25h9\n")
    return truth, survey


def _log(make: Callable[[], bytes]) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        log = path.with_name(f"{path.name}.mcap")
        log.write_bytes(make())
        return log

    return write


LOGS = {name: _log(make) for name, make in HOSTILE.items()}

# --- maps


def _map(folder: Path) -> Path:
    folder.mkdir()
    write_map(make_map(), folder)
    return folder


def _with_member(folder: Path, name: str, array: bytes, method: int = zipfile.ZIP_STORED) -> Path:
    """A map of whose arrays one holds other bytes, or that holds one more."""
    path = _map(folder) / ARRAYS_FILE
    with zipfile.ZipFile(path) as old:
        members = {each: old.read(each) for each in old.namelist()} | {f"{name}.npy": array}
    with zipfile.ZipFile(path, "w", method) as new:
        for each, data in members.items():
            new.writestr(each, data)
    return folder


def _array(descr: str, shape: tuple[int, ...], data: bytes = b"") -> bytes:
    """An array's bytes behind a head with any claims."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


def one_run_many_times(folder: Path) -> Path:
    """A run named over and over, whose trajectory is long."""
    path = _map(folder) / JSON_FILE
    data = json.loads(path.read_text())
    path.write_text(json.dumps(data | {"runs": data["runs"][:1] * 1200}))
    with np.load(folder / ARRAYS_FILE) as old:
        arrays: dict[str, Any] = dict(old) | {"component0_T_map_start": np.zeros((1200, 3))}
    np.savez(folder / ARRAYS_FILE, **arrays)
    (folder / "red_one.tum").write_text("1800000000.000000000 1 2 0 0 0 0 1\n" * 12_000)
    return folder


def long_exponent(folder: Path) -> Path:
    """A time that Decimal takes, but cannot count in nanoseconds."""
    (_map(folder) / "red_one.tum").write_text("1e999998 1 2 0 0 0 0 1\n")
    return folder


def nest(folder: Path) -> Path:
    """JSON deeper than Python calls itself."""
    (_map(folder) / JSON_FILE).write_text("[" * 500_000)
    return folder


MAPS: dict[str, Callable[[Path], Path]] = {
    "honest": _map,
    "arrays that unfold": lambda folder: _with_member(
        folder, "component0_joint_covariance", _array("<f8", (10_000, 10_000), bytes(800 * _MIB)), zipfile.ZIP_DEFLATED
    ),
    "an array's claimed shape": lambda folder: _with_member(
        folder, "component0_joint_covariance", _array("<f8", (1 << 20, 1 << 20))
    ),
    "texts of no length": lambda folder: _with_member(
        folder, "component0_calibration_owners", _array("<U0", (1 << 40,))
    ),
    "one run many times": one_run_many_times,
    "a long exponent": long_exponent,
    "nested JSON": nest,
}


# --- drives to import


def _csv(folder: Path, odometry: str, observations: str) -> Path:
    folder.mkdir()
    (folder / "odometry.csv").write_text(odometry)
    (folder / "observations.csv").write_text(observations)
    return folder


def many_columns(path: Path) -> Path:
    """A head of columns that are all different."""
    names = ",".join(["t_s", "left_m_s", "right_m_s", *map(str, range(140_000))])
    return _csv(path, names + "\n", "t_s,tag_id,x_m,y_m\n0.5,7,3,1\n")


def many_rows(path: Path) -> Path:
    """As many as there can be."""
    rows = "\n".join(f"{k},1,1" for k in range(45_000))
    seen = "\n".join(f"{k},{k % 600},1,1" for k in range(1, 28_000))
    return _csv(path, f"t_s,left_m_s,right_m_s\n{rows}\n", f"t_s,tag_id,x_m,y_m\n{seen}\n")


def _send(topic: str, msgtype: str) -> Sent:
    return Sent(topic, msgtype, _S, {"header": header(_S, topic[1:])})


def _ros1_bag(path: Path, data: bytes, count: int) -> Path:
    """Messages of nothing but `data`, in chunks of bz2."""
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat.BZ2)
    with writer:
        odometry = writer.add_connection("/odom", _ODOMETRY, typestore=STORE1)
        for index in range(count):
            writer.write(odometry, _S + index, data)
        tags = writer.add_connection("/tags", _TAGS1, typestore=STORE1)
        sent = _send("/tags", _TAGS1)
        writer.write(tags, _S, STORE1.serialize_ros1(make_message(STORE1, _TAGS1, sent.fields), _TAGS1))
    return path


def _in_sqlite(path: Path, view: str) -> Path:
    """A bag of ROS 2 whose messages are what a query makes up."""
    folder = write_bag(path.with_name("made_db3"), [_send("/odom", _ODOMETRY), _send("/tags", _TAGS2)])
    (found,) = folder.glob("*.db3")
    shutil.move(found, path)
    shutil.rmtree(folder)
    with sqlite3.connect(path) as database:
        database.execute("ALTER TABLE messages RENAME TO kept")
        database.execute(f"CREATE VIEW messages AS {view}")
    database.close()
    return path


def _in_mcap(path: Path, messages: Iterable[bytes], definition: str | None = None) -> Path:
    """A bag of ROS 2 with these messages as odometry, up to some 900 kB of it."""
    with path.open("wb") as stream:
        packed = CompressionType.NONE if definition else CompressionType.ZSTD
        writer = McapWriter(stream, compression=packed, chunk_size=8 * _MIB)
        writer.start(profile="ros2")
        channels = []
        for topic, msgtype in (("/odom", _ODOMETRY), ("/tags", _TAGS2)):
            text = definition or STORE2.generate_msgdef(msgtype, ros_version=2)[0]
            channels.append(
                writer.register_channel(topic, "cdr", writer.register_schema(msgtype, "ros2msg", text.encode()))
            )
        for data in messages:
            writer.add_message(channels[0], _S, data, _S)
            if stream.tell() > 900_000:
                break
        sent = _send("/tags", _TAGS2)
        data = bytes(STORE2.serialize_cdr(make_message(STORE2, _TAGS2, sent.fields), _TAGS2))
        writer.add_message(channels[1], _S, data, _S)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
    return path


def all_alike(path: Path) -> Path:
    """As many messages as zstd makes of 1 MiB."""
    sent = _send("/odom", _ODOMETRY)
    data = bytes(STORE2.serialize_cdr(make_message(STORE2, _ODOMETRY, sent.fields), _ODOMETRY))
    return _in_mcap(path, (data for _ in range(400_000)))


def long_metadata(path: Path) -> Path:
    """YAML that takes a parser long."""
    folder = write_bag(path, [_send("/odom", _ODOMETRY), _send("/tags", _TAGS2)])
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text() + "more: [" + "{a: [1]}, " * 90_000 + "]\n")
    return folder


IMPORTS: dict[str, Callable[[Path], Path]] = {
    "many columns": many_columns,
    "many rows": many_rows,
    "a bz2 bomb.bag": lambda path: _ros1_bag(path, bytes(300 * _MIB), 1),
    "many bz2 bombs.bag": lambda path: _ros1_bag(path, bytes(30 * _MIB), 40),
    "messages without end.db3": lambda path: _in_sqlite(
        path,
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
        "SELECT n.i AS id, kept.topic_id, n.i AS timestamp, kept.data FROM n, kept",
    ),
    "a message of a gigabyte.db3": lambda path: _in_sqlite(
        path, "SELECT id, topic_id, timestamp, zeroblob(900000000) AS data FROM kept"
    ),
    "long metadata": long_metadata,
    "messages all alike.mcap": all_alike,
    "a zstd bomb.mcap": lambda path: _in_mcap(path, [bytes(600 * _MIB)]),
    "a long definition.mcap": lambda path: _in_mcap(
        path, [bytes(100)], "".join(f"float64[<=10] a{k}\n" for k in range(11_000))
    ),
}


# --- truths, surveys and settings


def many_true_tags(path: Path) -> Path:
    """All of them different."""
    tags = [{"family": "a", "tag_id": k, "position_m": [0, 0]} for k in range(18_000)]
    path.write_text(json.dumps({"runs": {}, "tags": tags}))
    return path


def many_entries(path: Path) -> Path:
    """A survey none of whose places is right."""
    places_m = np.random.default_rng(0).uniform(-1e6, 1e6, (40_000, 2))
    rows = [f"{k},{x:.1f},{y:.1f}\n" for k, (x, y) in enumerate(places_m)]
    path.write_text("tag_id,x_m,y_m\n" + "".join(rows))
    return path


def _text(content: str) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        path.write_text(content)
        return path

    return write


_YAML: dict[str, Callable[[Path], Path]] = {
    "aliases.yaml": _text(yaml_bomb()),
    "brackets.yaml": _text("a: " + "[" * 900_000),
    "list.yaml": _text("a: [" + "{a: [1]}, " * 90_000 + "]\n"),
}

FILES: dict[str, dict[str, Callable[[Path], Path]]] = {
    "logs": FOLDERS,
    "run": RUN_FOLDERS,
    "map": MAPS,
    "import": IMPORTS,
    "truth": {"many tags.json": many_true_tags, "nested.json": _text("[" * 900_000)},
    "survey": {"many entries.csv": many_entries, "many columns.csv": _text(",".join(map(str, range(140_000))))},
    "robot": _YAML,
    "noise": _YAML,
}
"""By what they are; a name ends as the file must."""
