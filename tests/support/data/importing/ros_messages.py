"""Messages of ROS, and bags of them, by rosbags' writers."""

import sqlite3
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from groundsbot.offline.importing.bags.reader import DEFINITIONS

S = 1_000_000_000
BASE, CAMERA, ODOM = "base_link", "camera_optical", "odom"
# The interface of apriltag_ros for ROS 1, whose bags always carry it.
_ROS1_TYPES = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "apriltag_ros/msg/AprilTagDetection": (
        "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose\n"
    ),
    "apriltag_ros/msg/AprilTagDetectionArray": "std_msgs/Header header\napriltag_ros/AprilTagDetection[] detections\n",
}
_EMPTY: dict[str, Any] = {"float": 0.0, "string": "", "bool": False}


def make_stores() -> tuple[Typestore, Typestore]:
    """Of ROS 1 and ROS 2, with the types of AprilTag detectors."""
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _ROS1_TYPES.items():
        ros1.register(get_types_from_msg(text, name))
    for package in DEFINITIONS.values():
        for name, text in package.items():
            ros2.register(get_types_from_msg(text, name))
    return ros1, ros2


STORE1, STORE2 = make_stores()


class Sent(NamedTuple):
    """One message: fields that are not named are zero or empty."""

    topic: str
    msgtype: str
    received_ns: int
    fields: dict[str, Any]


def make_message(store: Typestore, msgtype: str, fields: dict[str, Any]) -> Any:
    """A message of a store's class; fields by name, messages within as such mappings."""
    unknown = set(fields) - {name for name, _ in store.fielddefs[msgtype][1]}
    assert not unknown, f"{msgtype} has no {unknown}"
    values = {name: _make(store, kind, fields.get(name)) for name, kind in store.fielddefs[msgtype][1]}
    return store.types[msgtype](**values)


def _make(store: Typestore, kind: Any, value: Any) -> Any:
    if kind[0] == Nodetype.NAME:
        return make_message(store, kind[1], value or {})
    if kind[0] == Nodetype.BASE:
        name = kind[1][0]
        return value if value is not None else _EMPTY.get(name.rstrip("0123456789"), 0)
    inner, length = kind[1]
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        dtype = np.dtype(inner[1][0].replace("bool", "bool_"))
        return np.zeros(length, dtype) if value is None else np.asarray(value, dtype)
    given = list(value) if value is not None else [None] * length
    return [_make(store, inner, each) for each in given]


def write_bag(path: Path, messages: Iterable[Sent]) -> Path:
    """A bag of ROS 1 if the name ends in .bag; else of ROS 2: a folder, of MCAP unless `db3` is in its name."""
    ordered = sorted(messages, key=lambda each: each.received_ns)
    is_ros1 = path.suffix == ".bag"
    store = STORE1 if is_ros1 else STORE2
    plugin = StoragePlugin.SQLITE3 if "db3" in path.name else StoragePlugin.MCAP
    connections: dict[tuple[str, str], Any] = {}
    writer: Any = Writer1(path) if is_ros1 else Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        for each in ordered:
            key = (each.topic, each.msgtype)
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=store)
            message = make_message(store, each.msgtype, _of_ros1(each.fields) if is_ros1 else each.fields)
            data = store.serialize_ros1(message, key[1]) if is_ros1 else store.serialize_cdr(message, key[1])
            writer.write(connections[key], each.received_ns, data)
    return path


def _of_ros1(fields: dict[str, Any]) -> dict[str, Any]:
    """ROS 1 wrote the matrices of CameraInfo large."""
    return {name.upper() if name in ("k", "d", "p") else name: value for name, value in fields.items()}


def without_definitions(bag: Path) -> Path:
    """The bag as older ROS 2 wrote it: without the messages' definitions."""
    (database,) = bag.glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("DROP TABLE message_definitions")
        connection.execute("UPDATE schema SET schema_version = 3")
    connection.close()
    return bag


def header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // S, "nanosec": stamp_ns % S}, "frame_id": frame}


def xyz(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def xyzw(rotation: Rotation) -> dict[str, float]:
    return dict(zip("xyzw", rotation.as_quat().tolist(), strict=True))
