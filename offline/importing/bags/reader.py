"""Reader of ROS 1 and ROS 2 bags without ROS: their topics and messages."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from groundsbot.calib.errors import GroundsbotError
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.limits import METADATA, MOST_DEFINITION_CHARS, BagLimits

# By package, then by type.
DEFINITIONS: Final = {
    "apriltag_msgs": {
        "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
        "apriltag_msgs/msg/AprilTagDetection": (
            "string family\n"
            "int32 id\n"
            "int32 hamming\n"
            "float32 goodness\n"
            "float32 decision_margin\n"
            "apriltag_msgs/Point centre\n"
            "apriltag_msgs/Point[4] corners\n"
            "float64[9] homography\n"
        ),
        "apriltag_msgs/msg/AprilTagDetectionArray": (
            "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections\n"
        ),
    },
    "isaac_ros_apriltag_interfaces": {
        "isaac_ros_apriltag_interfaces/msg/AprilTagDetection": (
            "string family\n"
            "int32 id\n"
            "geometry_msgs/Point center\n"
            "geometry_msgs/Point[4] corners\n"
            "geometry_msgs/PoseWithCovarianceStamped pose\n"
        ),
        "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
            "std_msgs/Header header\nisaac_ros_apriltag_interfaces/AprilTagDetection[] detections\n"
        ),
    },
}


_BAG_SUFFIXES: Final = (".bag", ".mcap", ".db3")
_IDL_RULE: Final = "=" * 80 + "\n"  # separates the files of an IDL definition


class BagTopic(NamedTuple):
    """One topic of a bag, and its number of messages of one type."""

    name: str
    msgtype: str  # as ROS 2 writes it: nav_msgs/msg/Odometry
    n_messages: int

    @property
    def short_type(self) -> str:
        """Type as ROS 1 writes it: nav_msgs/Odometry."""
        return self.msgtype.replace("/msg/", "/")


class BagMessage(NamedTuple):
    """One message. `content` has the fields of its definition, with number arrays as numpy arrays."""

    topic: str
    msgtype: str
    received_ns: int
    content: Any


def is_bag(path: Path) -> bool:
    """Whether this looks like a bag: a file by its suffix, a folder by its content."""
    if path.is_dir():
        return (path / METADATA).exists() or any(each.suffix in _BAG_SUFFIXES for each in path.iterdir())
    return path.suffix in _BAG_SUFFIXES


class Bag:
    """An open bag.

    Attributes:
        path: path of the file or folder.
        topics: those that have messages, sorted by name.
    """

    def __init__(self, path: Path, reader: Reader1 | Reader2, limits: BagLimits) -> None:
        """Wrap an open reader."""
        self.path = path
        self._limits = limits
        self._reader = reader
        self._is_ros1 = isinstance(reader, Reader1)
        self._stores: dict[str, Typestore] = {}
        counts: dict[tuple[str, str], int] = defaultdict(int)
        for connection in reader.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
        self.topics = [BagTopic(*key, count) for key, count in sorted(counts.items()) if count]

    def messages(self, topics: Sequence[BagTopic]) -> Iterator[BagMessage]:
        """Yield the messages of some topics, in the order of reception.

        Raises:
            OfflineError: the bag is damaged, or a type is unknown.
        """
        wanted = {(topic.name, topic.msgtype) for topic in topics}
        connections = [each for each in self._reader.connections if (each.topic, each.msgtype) in wanted]
        if not connections:
            return
        with _library_errors(self.path):
            stores = {each.msgtype: self._store(each) for each in connections}
            # The two readers take the same arguments; their common type does not.
            messages = self._reader.messages(connections=connections)
            for connection, received_ns, data in self._limits.count(messages):
                store = stores[connection.msgtype]
                deserialise = store.deserialize_ros1 if self._is_ros1 else store.deserialize_cdr
                content = deserialise(data, connection.msgtype)
                yield BagMessage(connection.topic, connection.msgtype, received_ns, content)

    def _store(self, connection: Connection) -> Typestore:
        """Return the definition of a type: the bag's own if there is one, else that of ROS, else ours."""
        msgtype = connection.msgtype
        if msgtype not in self._stores:
            carries_definition = connection.msgdef.format != MessageDefinitionFormat.NONE
            store = get_typestore(Stores.EMPTY if carries_definition else Stores.LATEST)
            if carries_definition:
                if len(connection.msgdef.data) > MOST_DEFINITION_CHARS:
                    raise OfflineError(
                        f"{self.path}: the definition of {msgtype} has {len(connection.msgdef.data)} characters, limit "
                        f"{MOST_DEFINITION_CHARS}; is the bag damaged? record it again"
                    )
                store.register(_types_of(connection.msgdef, msgtype))
            elif msgtype not in store.fielddefs:
                for name in DEFINITIONS.get(msgtype.partition("/")[0], {}):
                    store.register(get_types_from_msg(DEFINITIONS[msgtype.partition("/")[0]][name], name))
            if msgtype not in store.fielddefs:
                raise OfflineError(
                    f"{self.path}: {connection.topic} is of type {msgtype}, whose definition is neither in the bag nor "
                    "known here; record as MCAP, which carries definitions"
                )
            self._stores[msgtype] = store
        return self._stores[msgtype]


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag: a `.bag` file of ROS 1; a folder, an `.mcap` or a `.db3` file of ROS 2.

    Raises:
        OfflineError: it is missing, damaged, not finished, or not a bag; or, inside the block, a message does not match
            its type.
    """
    if not path.exists():
        raise OfflineError(f"{path}: does not exist; give a .bag file, a folder of ROS 2, or an .mcap or .db3 file")
    if path.is_dir() and not (path / METADATA).exists():
        raise OfflineError(f"{path}: has no {METADATA}, so its recording was cut short; run `ros2 bag reindex` on it")
    with _library_errors(path):
        limits = BagLimits(path)
        with limits.memory():
            reader = Reader1(path) if path.suffix == ".bag" and path.is_file() else Reader2(path)
            reader.open()
    try:
        with _library_errors(path):
            bag = Bag(path, reader, limits)
        with _content_errors(path):
            yield bag
    finally:
        reader.close()


def _types_of(definition: MessageDefinition, msgtype: str) -> dict[str, Any]:
    if definition.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(definition.data, msgtype)
    if not definition.data.startswith(f"{_IDL_RULE}IDL: "):
        return get_types_from_idl(definition.data)
    types: dict[str, Any] = {}
    for part in definition.data.split(_IDL_RULE)[1:]:
        types |= get_types_from_idl(part.partition("\n")[2])
    return types


@contextmanager
def _content_errors(path: Path) -> Iterator[None]:
    """Convert errors of access to a message's fields: the bag's own definition may lack fields of its type."""
    try:
        yield
    except (AttributeError, TypeError, ValueError, OverflowError, IndexError) as error:
        raise OfflineError(
            f"{path}: holds a message that is not as its type should be: {error}; was it damaged, or recorded under "
            "another definition?"
        ) from error


@contextmanager
def _library_errors(path: Path) -> Iterator[None]:
    """Convert every exception of the library, assertions included, to an error of one line."""
    try:
        yield
    except GroundsbotError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise OfflineError(
            f"{path}: cannot be read as a bag: {reason.rstrip('.')}; if its recording was cut short, mend it with "
            "`rosbag reindex`, `ros2 bag reindex` or `mcap recover`"
        ) from error
