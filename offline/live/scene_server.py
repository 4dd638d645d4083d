"""The map and the robots' poses for Foxglove and Lichtblick, over Foxglove's WebSocket."""

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap_protobuf.schema import build_file_descriptor_set

from groundsbot.calib.web import PageAddress, require_libraries
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import TimedMessage
from groundsbot.offline.live.ports import parse_address
from groundsbot.offline.live.poses import StampedPose
from groundsbot.offline.maps import MapResult, RobotPose, frame_of, robot_messages, scene_messages
from groundsbot.onboard.log import timestamp

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ChannelView, Client

_MOST_WAITING: Final = 256  # messages for a slow client; older ones are dropped


class SceneServer:
    """Topics of a map for viewers; of each topic, the newest message goes to clients that come later."""

    def __init__(self, address: PageAddress) -> None:
        """Serve.

        Raises:
            GroundsbotError: the address cannot be served, or the extra `foxglove` is not installed.
        """
        require_libraries("--foxglove", ("foxglove",), "foxglove")
        import foxglove
        from foxglove.websocket import ServerListener

        server = self

        class NewClients(ServerListener):
            """Sends the newest messages to new clients."""

            def on_subscribe(self, client: "Client", channel: "ChannelView") -> None:
                server._send_newest(channel.topic, client.id)

        self._lock = threading.Lock()
        self._channels: dict[str, Channel] = {}
        self._newest: dict[str, tuple[bytes, int]] = {}  # by topic, with the log time
        self._context = foxglove.Context()  # its channels end with it
        try:
            self._server = foxglove.start_server(
                name="groundsbot map",
                host=address.host,
                port=address.port,
                server_listener=NewClients(),
                context=self._context,
                message_backlog_size=_MOST_WAITING,
            )
        except RuntimeError as error:
            raise OfflineError(f"--foxglove {address}: cannot be served there ({error}); give another port") from error

    @property
    def port(self) -> int:
        """The port that is served."""
        return int(self._server.port)

    def show_map(self, result: MapResult, now_ns: int) -> None:
        """Show tags, drives and the newest pose of each drive, and remove those shown before."""
        self._publish(_replacing(scene_messages(result, now_ns), now_ns))
        newest = {
            run.run: RobotPose(run.run, frame_of(index), int(run.stamps_ns[-1]), run.T_map_base[-1])
            for index, component in enumerate(result.components)
            for run in component.runs
        }
        self._publish(robot_messages(list(newest.values())))

    def show_poses(self, found: Sequence[StampedPose]) -> None:
        """Show the poses of a robot in the first component of a finished map, where they are known."""
        for each in found:
            if each.pose is not None:
                pose = RobotPose(each.run, frame_of(0), each.stamp_ns, each.pose.T_map_base)
                self._publish(robot_messages([pose]))

    def close(self) -> None:
        """End all connections."""
        self._server.stop()

    def _publish(self, messages: Iterable[TimedMessage]) -> None:
        for each in messages:
            data = each.message.SerializeToString()
            with self._lock:
                channel = self._channels.get(each.topic) or self._add_channel(each)
                self._newest[each.topic] = data, each.stamp_ns
            channel.log(data, log_time=each.stamp_ns)

    def _add_channel(self, first: TimedMessage) -> "Channel":
        from foxglove import Channel, Schema

        kind = type(first.message)
        described = build_file_descriptor_set(kind).SerializeToString()
        schema = Schema(name=kind.DESCRIPTOR.full_name, encoding="protobuf", data=described)
        channel = Channel(first.topic, schema=schema, message_encoding="protobuf", context=self._context)
        self._channels[first.topic] = channel
        return channel

    def _send_newest(self, topic: str, client: int) -> None:
        """Send the newest message of a topic; called from any thread."""
        with self._lock:
            channel, newest = self._channels.get(topic), self._newest.get(topic)
        if channel is not None and newest is not None:
            channel.log(newest[0], log_time=newest[1], sink_id=client)


def _replacing(messages: Iterable[TimedMessage], now_ns: int) -> Iterator[TimedMessage]:
    """Yield scenes that remove all entities before them, so that tags that are gone do not stay."""
    for each in messages:
        if isinstance(each.message, SceneUpdate):
            # Entities of this scene have the stamp `now_ns`, and are not earlier.
            each.message.deletions.add(type=SceneEntityDeletion.ALL, timestamp=timestamp(now_ns))
        yield each


@contextmanager
def serve_scenes(address: str | None) -> Iterator[SceneServer | None]:
    """Serve viewers at [HOST:]PORT while the block runs; no server where it is None.

    Raises:
        GroundsbotError: it is no address, or cannot be served.
    """
    if address is None:
        yield None
        return
    server = SceneServer(parse_address(address, "--foxglove"))
    try:
        yield server
    finally:
        server.close()
