"""A client of Foxglove's WebSocket protocol, and layouts of Foxglove and Lichtblick."""

import json
import struct
from collections.abc import Collection, Iterator
from typing import Any

from google.protobuf.message import Message

from tests.support.devices.live_recording import PATIENCE_S

_DATA = struct.Struct("<BIQ")  # operation, subscription, log time in ns


class Watching:
    """A client that knows the channels, and reads the messages of topics."""

    def __init__(self, connection: Any, topics: Collection[str]) -> None:
        """Wait until just these topics are there."""
        self._connection = connection
        self.channels: dict[str, dict[str, Any]] = {}
        while self.channels.keys() != set(topics):
            told = json.loads(connection.recv(timeout=PATIENCE_S))
            for each in told.get("channels", []):
                self.channels[each["topic"]] = each

    def subscribe(self, *topics: str) -> None:
        wanted = [{"id": self.channels[each]["id"], "channelId": self.channels[each]["id"]} for each in topics]
        self._connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time in ns and bytes of each message as it comes."""
        topics = {each["id"]: topic for topic, each in self.channels.items()}
        while True:
            data = self._connection.recv(timeout=PATIENCE_S)
            if isinstance(data, bytes) and data[0] == 1:
                _, subscription, time_ns = _DATA.unpack_from(data)
                yield topics[subscription], time_ns, data[_DATA.size :]

    def receive(self, limit_s: float) -> str | bytes:
        received: str | bytes = self._connection.recv(timeout=limit_s)
        return received

    def next_of(self, topic: str, kind: type[Message]) -> Any:
        return kind.FromString(next(data for each, _, data in self.messages() if each == topic))


def panels_in(layout: Any) -> set[str]:
    """The panels that a layout's division of the window names."""
    return {layout} if isinstance(layout, str) else panels_in(layout["first"]) | panels_in(layout["second"])
