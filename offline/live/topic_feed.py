"""A recording under way by its live topics, which the recorder serves for viewers (`record --foxglove`).

Messages come here some milliseconds after they were measured, without the log's delay.
"""

import json
import struct
import threading
import time
from collections import deque
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from google.protobuf.message import DecodeError

from groundsbot.calib.foundation import printable
from groundsbot.offline.errors import OfflineError
from groundsbot.onboard.log import LogLosses, LogMessage, RunInfo, Topic, topic_of

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

_SCHEME: Final = "ws"
_RUN_TOPIC: Final = "/run"
_PROTOCOL: Final = "foxglove.sdk.v1"
_DATA: Final = struct.Struct("<BIQ")  # operation, subscription, log time in ns
_MESSAGE_DATA: Final = 1
_MOST_BYTES: Final = 4 << 20  # of a message; those of the topics that are wanted have some kB
_MOST_WAITING: Final = 100_000  # some 40 s of a recorder's messages
_OPEN_LIMIT_S: Final = 5.0
_PAUSE_S: Final = 1.0


def is_address(run: str) -> bool:
    """Return whether a run is given by an address, and not by a path."""
    return "://" in run


class TopicFeed:
    """Messages of the run that a recorder records now; a source of `GrowingRun`.

    A thread keeps up the connection, for ever: a recorder that is not there yet, or not any more, is tried again each
    second.

    Attributes:
        log: host and port, as the name of the log in messages.
        n_bytes: size of what has come.
        is_finished: never, as the recorder may begin another run.
        losses: none is known.
    """

    def __init__(self, url: str, topics: Collection[str], arrived: threading.Event) -> None:
        """Begin to connect.

        Args:
            url: ws://HOST:PORT.
            topics: topics to return.
            arrived: set when there is something new.

        Raises:
            OfflineError: the address is none, or the extra `foxglove` is not installed.
        """
        self.log = Path(_host_and_port(url))
        self.n_bytes = 0
        self.is_finished = False
        self.losses = LogLosses()
        self._topics = topics
        self._arrived = arrived
        self._lock = threading.Lock()
        self._new: deque[LogMessage] = deque(maxlen=_MOST_WAITING)
        self._reason = "no connection yet"
        self._run: tuple[str, str] | None = None  # ids of the robot and of its run
        self._is_another = False
        threading.Thread(target=self._work, args=(url,), name="topics", daemon=True).start()

    def read(self) -> list[LogMessage] | None:
        """Return the new messages in the order in which they were recorded; None once when another run has begun.

        Raises:
            OfflineError: there is nothing new, and no connection.
        """
        with self._lock:
            if self._is_another:
                self._is_another = False
                return None
            new = list(self._new)
            self._new.clear()
            reason = self._reason
        if not new and reason:
            raise OfflineError(f"{self.log}: {reason}; it is tried again each second")
        return new

    def _work(self, url: str) -> None:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        while True:
            try:
                with connect(
                    url, subprotocols=[Subprotocol(_PROTOCOL)], max_size=_MOST_BYTES, open_timeout=_OPEN_LIMIT_S
                ) as connection:
                    self._take_all(connection)
            except (OSError, WebSocketException, ValueError, KeyError, TypeError, struct.error) as error:
                with self._lock:
                    self._reason = f"no connection ({printable(str(error)) or type(error).__name__})"
                self._arrived.set()
            time.sleep(_PAUSE_S)

    def _take_all(self, connection: "ClientConnection") -> None:
        """Subscribe to the topics as they are advertised, and take messages until the connection ends."""
        topics: dict[int, Topic] = {}  # by subscription, which has the channel's number
        for data in connection:
            if isinstance(data, str):
                added = self._wanted_topics(json.loads(data))
                topics |= added
                if added:
                    # What belongs to a run must come after the message that begins it.
                    for channel in sorted(added, key=lambda each: added[each].kind != _RUN_TOPIC):
                        wanted = [{"id": channel, "channelId": channel}]
                        connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                    with self._lock:
                        self._reason = ""
            elif data[0] == _MESSAGE_DATA:
                _, subscription, log_time_ns = _DATA.unpack_from(data)
                self._take(topics[subscription], data[_DATA.size :], log_time_ns)

    def _wanted_topics(self, document: Any) -> dict[int, Topic]:  # noqa: ANN401 - of another program
        """Return the wanted topics that a server advertises, by channel."""
        channels = document["channels"] if document["op"] == "advertise" else []
        found = {int(each["id"]): topic_of(each["topic"]) for each in channels}
        return {channel: topic for channel, topic in found.items() if topic is not None and topic.kind in self._topics}

    def _take(self, topic: Topic, data: bytes, log_time_ns: int) -> None:
        try:
            message = topic.schema.FromString(data)
        except DecodeError as error:
            raise ValueError(f"a message of {topic.name} cannot be decoded") from error
        with self._lock:
            if isinstance(message, RunInfo) and (message.robot_id, message.run_id) != self._run:
                if self._run is not None:
                    self._is_another = True
                    self._new.clear()
                self._run = message.robot_id, message.run_id
            self._new.append(LogMessage(topic.name, message, log_time_ns, log_time_ns))
            self.n_bytes += len(data)
        self._arrived.set()


def _host_and_port(url: str) -> str:
    """Return HOST:PORT of an address.

    Raises:
        OfflineError: it is none, or the library for it is missing.
    """
    try:
        parts = urlsplit(url)
        is_usable = parts.scheme == _SCHEME and parts.hostname and parts.port and parts.path in ("", "/")
    except ValueError:  # a port that is none
        parts, is_usable = urlsplit(""), False
    if not is_usable:
        raise OfflineError(
            f"{url}: is no address of live topics; give ws://HOST:PORT, as `groundsbot-onboard record --foxglove` "
            "prints it"
        )
    try:
        import websockets  # noqa: F401 - whether it is there
    except ImportError as error:
        raise OfflineError(
            f"{url}: live topics need websockets, which is not installed; pip install 'groundsbot[foxglove]'"
        ) from error
    return parts.netloc
