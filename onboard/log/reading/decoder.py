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

_MESSAGE_FIXED_BYTES: Final = MESSAGE_HEAD.size - RECORD_HEAD.size
_HEAD_RECORDS: Final = 1000


class LogMessage(NamedTuple):
    """One message of a log; times in ns on the run's clock."""

    topic: str
    message: Message
    log_time_ns: int
    publish_time_ns: int


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
        # Topic and class by channel, or None if the topic is not wanted.
        self._channels: dict[int, tuple[str, type[Message]] | None] = {}
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

    def messages(self, chunk: bytes) -> Iterator[LogMessage]:
        """Yield the messages of a chunk.

        Raises:
            LogError: the file is not a groundsbot log: it does not begin with `/run`, or a topic has another schema.
        """
        try:
            yield from self._messages(chunk)
        except (struct.error, UnicodeDecodeError) as error:
            self._on_undecodable(f"a record in a chunk cannot be decoded: {error}")

    def _messages(self, chunk: bytes) -> Iterator[LogMessage]:
        position, end = 0, len(chunk)
        message_head, head_size, fixed_size = MESSAGE_HEAD.unpack_from, MESSAGE_HEAD.size, _MESSAGE_FIXED_BYTES
        while position < end:
            opcode, length, following = self._next_record(chunk, position)
            if opcode == Opcode.MESSAGE:
                if length < fixed_size:
                    raise struct.error(f"a message of {length} bytes")
                _, _, channel, _, log_time_ns, publish_time_ns = message_head(chunk, position)
                target = self._target(channel)
                if target is not None:
                    try:
                        message = target[1].FromString(chunk[position + head_size : following])
                    except DecodeError as error:
                        self._on_undecodable(f"a message of {target[0]} cannot be decoded: {error}")
                    else:
                        yield LogMessage(target[0], message, log_time_ns, publish_time_ns)
            elif opcode == Opcode.SCHEMA:
                self._add_schema(chunk, position + RECORD_HEAD.size)
            elif opcode == Opcode.CHANNEL:
                self._add_channel(chunk, position + RECORD_HEAD.size)
            position = following

    def _next_record(self, chunk: bytes, position: int) -> tuple[int, int, int]:
        """Return the code and the length of a record, and the position of the next one."""
        opcode, length = RECORD_HEAD.unpack_from(chunk, position)
        following = position + RECORD_HEAD.size + length
        if following > len(chunk) or opcode == 0:
            raise struct.error("a record does not fit in its chunk")
        self.n_records += 1
        if self.n_records > self._n_allowed:
            raise struct.error(f"more than {self._n_allowed} records up to here")
        return opcode, length, following

    def _target(self, channel: int) -> tuple[str, type[Message]] | None:
        if self._first and channel != self._run_channel:
            raise LogError(
                f"{self._path}: does not begin with /run, so it is not a groundsbot log; import it or choose another"
            )
        self._first = False
        if channel not in self._channels:
            self._on_undecodable(f"a message on channel {channel}, which is not declared")
            return None
        return self._channels[channel]

    def _add_schema(self, chunk: bytes, position: int) -> None:
        (identifier,) = U16.unpack_from(chunk, position)
        self._schemas[identifier], _ = read_text(chunk, position + U16.size)

    def _add_channel(self, chunk: bytes, position: int) -> None:
        identifier, schema = U16.unpack_from(chunk, position)[0], U16.unpack_from(chunk, position + U16.size)[0]
        name, position = read_text(chunk, position + 2 * U16.size)
        encoding, _ = read_text(chunk, position)
        topic = topic_of(name)
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
        self._channels[identifier] = (name, topic.schema) if wanted else None

    def _refuse(self, reason: str) -> NoReturn:
        raise LogError(f"{self._path}: {reason}")
