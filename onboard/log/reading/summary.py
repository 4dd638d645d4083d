"""The summary at the end of a finished MCAP file."""

import struct
import zlib
from typing import BinaryIO, Final, NamedTuple

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from groundsbot.onboard.log.reading.record_bytes import RECORD_HEAD, U32

_FOOTER: Final = struct.Struct("<BQQQI")  # code, length, start of the summary, of its offsets, CRC-32
_STATISTICS: Final = struct.Struct("<QHIIII")  # messages, schemas, channels, attachments, metadata, chunks
_DATA_END_BYTES: Final = RECORD_HEAD.size + U32.size


class Summary(NamedTuple):
    """The summary of a file."""

    data_end: int  # offset of the end mark
    n_messages: int | None  # None without statistics
    n_chunks: int | None
    declarations: bytes  # records of schemas and channels, as in a chunk


def read_summary(stream: BinaryIO, size: int, limit_bytes: int) -> Summary | None:
    """Return the summary of a file of `size` bytes, or None if it is missing, damaged or longer than the limit."""
    end = size - len(MCAP0_MAGIC) - _FOOTER.size
    if end < len(MCAP0_MAGIC) + _DATA_END_BYTES:
        return None
    stream.seek(end)
    footer, magic = stream.read(_FOOTER.size), stream.read(len(MCAP0_MAGIC))
    if magic != MCAP0_MAGIC or len(footer) < _FOOTER.size:
        return None
    opcode, length, start, _, crc = _FOOTER.unpack(footer)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - RECORD_HEAD.size:
        return None
    start = start or end
    if not _DATA_END_BYTES + len(MCAP0_MAGIC) <= start <= end or end - start > limit_bytes:
        return None
    stream.seek(start)
    data = stream.read(end - start)
    if crc == 0 or zlib.crc32(footer[: -U32.size], zlib.crc32(data)) != crc:
        return None
    stream.seek(start - _DATA_END_BYTES)
    if RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size)) != (Opcode.DATA_END, U32.size):
        return None
    return _parse(data, start - _DATA_END_BYTES)


def _parse(data: bytes, data_end: int) -> Summary | None:
    declarations = []
    n_messages = n_chunks = None
    position = 0
    while position < len(data):
        if position + RECORD_HEAD.size > len(data):
            return None
        opcode, length = RECORD_HEAD.unpack_from(data, position)
        following = position + RECORD_HEAD.size + length
        if following > len(data):
            return None
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            declarations.append(data[position:following])
        elif opcode == Opcode.STATISTICS:
            if length < _STATISTICS.size:
                return None
            n_messages, *_, n_chunks = _STATISTICS.unpack_from(data, position + RECORD_HEAD.size)
        position = following
    return Summary(data_end, n_messages, n_chunks, b"".join(declarations))
