"""The recording's topics for Foxglove and Lichtblick, over Foxglove's WebSocket."""

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

from google.protobuf.message import Message
from mcap_protobuf.schema import build_file_descriptor_set

from groundsbot.calib.robot import PageAddress
from groundsbot.onboard.log import TOPICS, CompressedImage, timestamp

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import ChannelView, Client

PREVIEW_TOPIC: Final = "/camera/preview"  # what the page shows: small, with the outlines of tags
VIEWER_TOPICS: Final = frozenset({*TOPICS, PREVIEW_TOPIC})
_MOST_WAITING: Final = 64  # messages that wait for a slow client; older ones are dropped


class LiveMessage(NamedTuple):
    """A message of the log."""

    topic: str
    data: bytes  # serialised
    log_time_ns: int


def live_message(topic: str, message: Message, log_time_ns: int) -> LiveMessage:
    """Return a message as bytes."""
    return LiveMessage(topic, message.SerializeToString(), log_time_ns)


class Viewer:
    """WebSocket server of the recording's topics; nothing can be done through it but to look."""

    def __init__(self, address: PageAddress, name: str, on_topics: Callable[[frozenset[str]], None]) -> None:
        """Serve.

        Args:
            address: where.
            name: name of the server.
            on_topics: called from any thread with all topics that clients are subscribed to, when they change.

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

        self._on_topics = on_topics
        self._subscribed: set[tuple[str, int]] = set()
        self._heads: dict[str, LiveMessage] = {}
        self._context = context = foxglove.Context()  # its channels end with it
        schemas = {each.name: each.schema for each in TOPICS.values()} | {PREVIEW_TOPIC: CompressedImage}
        self._channels = {topic: _channel(topic, schema, context) for topic, schema in schemas.items()}
        self._server = foxglove.start_server(
            name=name,
            host=address.host,
            port=address.port,
            server_listener=Listener(),
            context=context,
            message_backlog_size=_MOST_WAITING,
        )

    def publish_head(self, head: Iterable[LiveMessage]) -> None:
        """Publish the head of a run, now and to whoever subscribes later."""
        self._heads = {each.topic: each for each in head}
        self.publish(self._heads.values())

    def publish(self, messages: Iterable[LiveMessage]) -> None:
        """Publish messages to those who are subscribed to their topics."""
        for each in messages:
            self._channels[each.topic].log(each.data, log_time=each.log_time_ns)

    def publish_preview(self, jpeg: bytes, time_ns: int) -> None:
        """Publish the page's picture."""
        image = CompressedImage(timestamp=timestamp(time_ns), data=jpeg, format="jpeg")
        self.publish([live_message(PREVIEW_TOPIC, image, time_ns)])

    def _change(self, topic: str, client: int, *, is_added: bool) -> None:
        before = self.topics
        (self._subscribed.add if is_added else self._subscribed.discard)((topic, client))
        if is_added and topic in self._heads:
            self.publish([self._heads[topic]])
        if self.topics != before:
            self._on_topics(self.topics)

    @property
    def topics(self) -> frozenset[str]:
        """Topics that somebody is subscribed to."""
        return frozenset(topic for topic, _ in self._subscribed)


def serialise_head(head: Mapping[str, Message], log_time_ns: int) -> tuple[LiveMessage, ...]:
    """Return the messages of a head as bytes."""
    return tuple(live_message(topic, message, log_time_ns) for topic, message in head.items())


def _channel(topic: str, schema: type[Message], context: "Context") -> "Channel":
    from foxglove import Channel, Schema

    described = build_file_descriptor_set(schema).SerializeToString()
    return Channel(
        topic,
        schema=Schema(name=schema.DESCRIPTOR.full_name, encoding="protobuf", data=described),
        message_encoding="protobuf",
        context=context,
    )
