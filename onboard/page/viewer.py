"""The recording's topics for Foxglove and Lichtblick, over Foxglove's WebSocket."""

import re
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

from google.protobuf.message import Message
from mcap_protobuf.schema import build_file_descriptor_set

from groundsbot.calib.web import PageAddress
from groundsbot.onboard.log import (
    CompressedImage,
    LogHead,
    camera_topic,
    head_messages,
    is_picture_topic,
    timestamp,
    topic_of,
    topics_of_cameras,
)

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import ChannelView, Client

PREVIEW_TOPIC: Final = "/camera/preview"  # what the page shows: small, with the outlines of tags
_PREVIEW_OF_CAMERA: Final = re.compile(r"/camera/[a-z][a-z0-9_]{0,15}/preview")
MOST_VIEWERS: Final = 8
_MOST_PICTURE_VIEWERS: Final = 2
_MOST_WAITING: Final = 256  # messages that wait for a slow client, a quarter of a second; older ones are dropped
_REPORT_PERIOD_S: Final = 0.2


def viewer_topics(cameras: Sequence[str]) -> frozenset[str]:
    """Return the topics for viewers of a robot with these `camera_names`."""
    return frozenset({*topics_of_cameras(cameras), *(camera_topic(PREVIEW_TOPIC, name) for name in cameras)})


def is_viewer_topic(topic: object) -> bool:
    """Return whether an untrusted value is a topic for viewers of some robot."""
    if not isinstance(topic, str):
        return False
    return topic == PREVIEW_TOPIC or topic_of(topic) is not None or bool(_PREVIEW_OF_CAMERA.fullmatch(topic))


class LiveMessage(NamedTuple):
    """A message of the log."""

    topic: str
    data: bytes  # serialised
    log_time_ns: int


def live_message(topic: str, message: Message, log_time_ns: int) -> LiveMessage:
    """Return a message as bytes."""
    return LiveMessage(topic, message.SerializeToString(), log_time_ns)


class Viewer:
    """WebSocket server of the recording's topics; nothing can be done through it but to look.

    Messages go to `MOST_VIEWERS` clients, those that came first, and whole pictures to fewer, so that clients that do
    not read cost little memory.
    """

    def __init__(
        self, address: PageAddress, name: str, cameras: Sequence[str], on_topics: Callable[[frozenset[str]], None]
    ) -> None:
        """Serve.

        Args:
            address: where.
            name: name of the server.
            cameras: names of the robot's cameras.
            on_topics: called from a thread with all topics that clients are subscribed to, when they have changed, and
                a few times a second at most.

        Raises:
            RuntimeError: the address cannot be served.
        """
        import foxglove
        from foxglove.websocket import ServerListener

        viewer = self

        class Listener(ServerListener):
            """Counter of the subscriptions."""

            def on_subscribe(self, client: "Client", channel: "ChannelView") -> None:
                viewer._change(channel.topic, client.id, is_added=True)

            def on_unsubscribe(self, client: "Client", channel: "ChannelView") -> None:
                viewer._change(channel.topic, client.id, is_added=False)

        self._lock = threading.Lock()  # of the subscriptions and of the head
        self._subscribed: dict[int, set[str]] = {}  # topics by client
        self._heads: tuple[LiveMessage, ...] = ()
        self._changed = threading.Event()
        self._context = context = foxglove.Context()  # its channels end with it
        self._channels = {topic: _channel(topic, _schema_of(topic), context) for topic in viewer_topics(cameras)}
        self._server = foxglove.start_server(
            name=name,
            host=address.host,
            port=address.port,
            server_listener=Listener(),
            context=context,
            message_backlog_size=_MOST_WAITING,
        )
        threading.Thread(target=self._report, args=(on_topics,), name="topics", daemon=True).start()

    def publish_head(self, head: Iterable[LiveMessage]) -> None:
        """Publish the head of a run, now and to whoever subscribes later."""
        with self._lock:
            self._heads = heads = tuple(head)
        self.publish(heads)

    def publish(self, messages: Iterable[LiveMessage]) -> None:
        """Publish messages to those who are subscribed to their topics."""
        with self._lock:
            clients = [(client, frozenset(self._subscribed[client])) for client in self._receivers()]
        of_pictures = [client for client, topics in clients if any(map(is_picture_topic, topics))]
        for each in messages:
            for client, topics in clients:
                is_allowed = not is_picture_topic(each.topic) or client in of_pictures[:_MOST_PICTURE_VIEWERS]
                if each.topic in topics and is_allowed:
                    self._send(each, client)

    def publish_preview(self, jpeg: bytes, time_ns: int, camera: str) -> None:
        """Publish the page's picture of a camera."""
        image = CompressedImage(timestamp=timestamp(time_ns), data=jpeg, format="jpeg")
        self.publish([live_message(camera_topic(PREVIEW_TOPIC, camera), image, time_ns)])

    def _send(self, message: LiveMessage, client: int) -> None:
        self._channels[message.topic].log(message.data, log_time=message.log_time_ns, sink_id=client)

    def _receivers(self) -> list[int]:
        """Return the clients that get messages; the caller holds the lock."""
        return sorted(self._subscribed)[:MOST_VIEWERS]  # numbers grow

    def _change(self, topic: str, client: int, *, is_added: bool) -> None:
        """Note a subscription or its end; called from any thread."""
        heads: list[LiveMessage] = []
        with self._lock:
            if is_added:
                self._subscribed.setdefault(client, set()).add(topic)
                heads = [each for each in self._heads if each.topic == topic and client in self._receivers()]
            else:
                self._subscribed.get(client, set()).discard(topic)
                if not self._subscribed.get(client):
                    self._subscribed.pop(client, None)
        for head in heads:
            self._send(head, client)
        self._changed.set()

    def _report(self, on_topics: Callable[[frozenset[str]], None]) -> None:
        reported: frozenset[str] = frozenset()
        while True:
            self._changed.wait()
            self._changed.clear()
            with self._lock:
                topics = frozenset(topic for client in self._receivers() for topic in self._subscribed[client])
            if topics != reported:
                on_topics(topics)
                reported = topics
            time.sleep(_REPORT_PERIOD_S)


def serialise_head(head: LogHead, log_time_ns: int) -> tuple[LiveMessage, ...]:
    """Return the messages of a head as bytes."""
    return tuple(live_message(topic, message, log_time_ns) for topic, message in head_messages(head))


def _schema_of(topic: str) -> type[Message]:
    known = topic_of(topic)
    return CompressedImage if known is None else known.schema  # else it is a preview


def _channel(topic: str, schema: type[Message], context: "Context") -> "Channel":
    from foxglove import Channel, Schema

    described = build_file_descriptor_set(schema).SerializeToString()
    return Channel(
        topic,
        schema=Schema(name=schema.DESCRIPTOR.full_name, encoding="protobuf", data=described),
        message_encoding="protobuf",
        context=context,
    )
