"""Decoding of the records of chunks to messages; records that do not fit the schemas are refused."""

import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

from google.protobuf.message import DecodeError, Message
from mcap.opcode import Opcode

from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.messages import topic_of
from groundsbot.onboard.log.reading.record_bytes import MESSAGE_HEAD, RECORD_HEAD, U16, read_text

_MESSAGE: Final = int(Opcode.MESSAGE)  # comparisons with the enumeration's member take three times as long
_HEAD_RECORDS: Final = 1000
_MOST_AT_ONCE: Final = 1000  # messages in a list; a hostile chunk may hold a million


class LogMessage(NamedTuple):
    """One message of a log; times in ns on the run's clock."""

    topic: str
    message: Message
    log_time_ns: int
    publish_time_ns: int


class _Target(NamedTuple):
    """What the messages of a channel become."""

    topic: str
    parse: Callable[[bytes], Message]
    is_head: bool


class MessageDecoder:
    """Decoder for the chunks of one file.

    Attributes:
        n_records: number of records read so far.
    """

    def __init__(self, path: Path, topics: Collection[str] | None, on_undecodable: Callable[[str], None]) -> None:
        """Start without channels.

        Args:
            path: name of the file in errors.
            topics: topics to return; None for all. One of a single camera stands for those of all cameras, too.
            on_undecodable: called with the reason for each message that cannot be decoded; may raise to end the
                reading.
        """
        self._path = path
        self._topics = topics
        self._on_undecodable = on_undecodable
        self._schemas: dict[int, str] = {}
        # By channel; None if the topic is not wanted. And of these the channels with messages.
        self._channels: dict[int, _Target | None] = {}
        self._begun: dict[int, _Target | None] = {}
        self._run_channel: int | None = None
        self._first = True
        self._n_allowed = _HEAD_RECORDS
        self.n_records = 0

    def allow(self, n_records: int) -> None:
        """Set the largest total number of records."""
        self._n_allowed = n_records

    def begin_without_head(self, declarations: bytes) -> None:
        """Read the channels from the index's copies of their records, if the first chunk and `/run` are lost."""
        self._first = False
        for _ in self.messages(declarations):
            pass

    def messages(self, chunk: bytes) -> Iterator[list[LogMessage]]:
        """Yield the messages of a chunk in lists, in which only the last message may be of a head topic.

        Raises:
            LogError: the file is not a groundsbot log: it does not begin with `/run`, or a topic has another schema.
        """
        position = 0
        while position < len(chunk):
            found: list[LogMessage] = []
            failure: Exception | None = None
            try:
                position = self._read(chunk, position, found)
            except (LogError, struct.error, UnicodeDecodeError) as error:
                failure = error
            if found:
                yield found
            if isinstance(failure, LogError):
                raise failure
            if failure is not None:
                self._on_undecodable(f"a record in a chunk cannot be decoded: {failure}")
                return

    def _read(self, chunk: bytes, position: int, found: list[LogMessage]) -> int:
        """Append the messages from a position on to a list, and return the position where the next list begins."""
        # Looked up once, since a log has a hundred thousand messages and more.
        record_head, record_head_size = RECORD_HEAD.unpack_from, RECORD_HEAD.size
        message_head, message_head_size = MESSAGE_HEAD.unpack_from, MESSAGE_HEAD.size
        begun, new, end = self._begun, tuple.__new__, len(chunk)
        while position < end:
            opcode, length = record_head(chunk, position)
            start = position + record_head_size
            position = start + length
            if position > end or opcode == 0:
                raise struct.error("a record does not fit in its chunk")
            self.n_records += 1
            if self.n_records > self._n_allowed:
                raise struct.error(f"more than {self._n_allowed} records up to here")
            if opcode != _MESSAGE:
                self._add_declaration(opcode, chunk, start)
                continue
            if length < message_head_size:
                raise struct.error(f"a message of {length} bytes")
            channel, _, log_time_ns, publish_time_ns = message_head(chunk, start)
            target = begun[channel] if channel in begun else self._target(channel)
            if target is None:
                continue
            topic, parse, is_head = target
            try:
                message = parse(chunk[start + message_head_size : position])
            except DecodeError as error:
                self._on_undecodable(f"a message of {topic} cannot be decoded: {error}")
                continue
            found.append(new(LogMessage, (topic, message, log_time_ns, publish_time_ns)))
            if is_head or len(found) == _MOST_AT_ONCE:
                break
        return position

    def _add_declaration(self, opcode: int, chunk: bytes, position: int) -> None:
        if opcode == Opcode.SCHEMA:
            self._add_schema(chunk, position)
        elif opcode == Opcode.CHANNEL:
            self._add_channel(chunk, position)

    def _target(self, channel: int) -> "_Target | None":
        """Return what the first message of a channel needs."""
        if self._first and channel != self._run_channel:
            raise LogError(
                f"{self._path}: does not begin with /run, so it is not a groundsbot log; import it or choose another"
            )
        self._first = False
        if channel not in self._channels:
            self._on_undecodable(f"a message on channel {channel}, which is not declared")
            return None
        self._begun[channel] = self._channels[channel]
        return self._begun[channel]

    def _add_schema(self, chunk: bytes, position: int) -> None:
        (identifier,) = U16.unpack_from(chunk, position)
        self._schemas[identifier], _ = read_text(chunk, position + U16.size)

    def _add_channel(self, chunk: bytes, position: int) -> None:
        identifier, schema = U16.unpack_from(chunk, position)[0], U16.unpack_from(chunk, position + U16.size)[0]
        name, position = read_text(chunk, position + 2 * U16.size)
        encoding, _ = read_text(chunk, position)
        topic = topic_of(name)
        self._begun.pop(identifier, None)
        if topic is None:  # an unknown topic of another program
            self._channels[identifier] = None
            return
        expected, found = topic.schema.DESCRIPTOR.full_name, self._schemas.get(schema, "nothing")
        if found != expected or encoding != "protobuf":
            self._refuse(
                f"topic {name} holds {found} in {encoding}, must be {expected} in protobuf, so it is not a groundsbot "
                "log; import it or choose another"
            )
        if name == "/run":
            self._run_channel = identifier
        wanted = self._topics is None or name in self._topics or topic.kind in self._topics
        self._channels[identifier] = _Target(name, topic.schema.FromString, topic.every_file) if wanted else None

    def _refuse(self, reason: str) -> NoReturn:
        raise LogError(f"{self._path}: {reason}")
