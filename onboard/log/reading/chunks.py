"""Chunks of an MCAP file that may be damaged, each with its checksum checked, one in memory at a time."""

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from groundsbot.calib.foundation import is_jpeg
from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.losses import Damage
from groundsbot.onboard.log.reading.allowance import Allowance
from groundsbot.onboard.log.reading.record_bytes import CHUNK_HEAD, RECORD_HEAD, U16, U32, U64, read_text
from groundsbot.onboard.log.reading.summary import Summary, read_summary

# A damaged or hostile file may claim any length. Chunks written by this project contain a mebibyte and one picture.
RECORD_LIMIT_BYTES: Final = 64 << 20
# Uncompressed size over file size. Chunks of this project compress to an eighth at best, those of a bomb to a
# thousandth.
_UNFOLDED_SHARE: Final = 24
_SEARCH_SHARE: Final = 4  # size of false beginnings of chunks that a search may check, over file size
_WINDOW_BYTES: Final = 1 << 20
_LOOK_BYTES: Final = 4 << 20  # range of the search for a chunk in a file that does not begin as MCAP
_DATA_END_BYTES: Final = 4
_TIME_LIMIT_NS: Final = 1 << 63
_CHUNK_OPCODE: Final = bytes([Opcode.CHUNK])
_SMALLEST_CHUNK_BYTES: Final = CHUNK_HEAD.size + U32.size + U64.size


class _BadRecordError(Exception):
    """Error: a record cannot be read. If `foreign`, it is intact but in an unsupported format."""

    def __init__(self, reason: str, foreign: bool = False) -> None:
        super().__init__(reason)
        self.foreign = foreign


class _Record(NamedTuple):
    opcode: int
    content: bytes
    following: int


class ChunkReader:
    """Iterator over the uncompressed contents of a file's chunks.

    After damage it continues with the next intact chunk, which is found by its form and its checksum.

    Attributes:
        summary: the summary of a finished file with an intact index, or None.
        n_chunks: number of chunks yielded so far.
        is_finished: whether the end mark (MCAP's DataEnd record) was reached.
        end_offset: offset at which reading ended without an end mark.
        offset: offset behind the last chunk yielded.
    """

    def __init__(
        self,
        stream: BinaryIO,
        path: Path,
        on_damage: Callable[[Damage], None],
        allowance: Allowance | None = None,
        start: int = 0,
    ) -> None:
        """Read the beginning and the end of the file.

        Args:
            stream: the file.
            path: name of the file in errors.
            on_damage: called with each place that cannot be read; may raise to end the reading.
            allowance: limits beyond the shares of the file's size; a new one if None.
            start: offset behind a chunk that was read before; 0: all chunks are read.

        Raises:
            LogError: the file is empty or not MCAP.
        """
        self.n_chunks = 0
        self.is_finished = False
        self.end_offset, self.offset = 0, start
        self._stream = stream
        self._path = path
        self._on_damage = on_damage
        self._size = stream.seek(0, 2)
        self._crc: int | None = None if start else zlib.crc32(MCAP0_MAGIC)
        self._allowance = allowance or Allowance()
        self._unfolded = self._unfolded_drawn = 0  # drawn: taken from the allowance
        self._searched = self._searched_drawn = 0
        stream.seek(0)
        magic = stream.read(len(MCAP0_MAGIC))
        if not magic:
            raise LogError(f"{path}: is empty (0 bytes); choose another log")
        self._starts_well = magic == MCAP0_MAGIC
        self.summary: Summary | None = read_summary(stream, self._size, RECORD_LIMIT_BYTES)
        self._end = self._size if self.summary is None else self.summary.data_end
        if not self._starts_well and self.summary is None and self._next_chunk(0, _LOOK_BYTES) is None:
            picture = "a JPEG picture, " if is_jpeg(magic) else ""
            raise LogError(
                f"{path}: is {picture}not an MCAP file; give a log, which ends in .mcap and is written by record, "
                "simulate or import"
            )

    def __iter__(self) -> Iterator[bytes]:
        """Yield the records of each intact chunk."""
        offset = trusted = max(self.offset, len(MCAP0_MAGIC))  # trusted: verified by checksums up to here
        if not self._starts_well and not self.offset:
            self._offset(0, len(MCAP0_MAGIC), "the file's first bytes are not MCAP's")
        while True:
            try:
                record = self._record_at(offset)
                if record is None:
                    return
                if record.opcode == Opcode.CHUNK:
                    chunk = self._uncompress(record.content)
                    self.n_chunks += 1
                    self.offset = record.following
                    yield chunk
                    trusted = record.following
                offset = record.following
            except _BadRecordError as bad:
                found = self._next_chunk(trusted + 1 if offset == trusted else trusted)
                self._report(offset, trusted, found, bad)
                if found is None:
                    self.end_offset = self._end
                    return
                offset = trusted = found

    def _report(self, offset: int, trusted: int, found: int | None, bad: _BadRecordError) -> None:
        self._crc = None
        start = offset if found is None or found > offset else trusted
        until = self._end if found is None else found
        self._offset(start, until - start, str(bad))

    def _offset(self, offset: int, n_bytes: int, reason: str) -> None:
        self._on_damage(Damage(self._path, offset, n_bytes, reason))

    def _record_at(self, offset: int) -> _Record | None:
        """Return the record at an offset, or None at the end of the data. Foreign records have no content."""
        self._stream.seek(offset)
        head = self._stream.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            if head:
                self._offset(offset, len(head), "torn")
            self.end_offset = offset
            return None
        opcode, length = RECORD_HEAD.unpack(head)
        following = offset + RECORD_HEAD.size + length
        if opcode == Opcode.DATA_END:
            self._check_end(offset, length)
            return None
        if following > self._size:
            raise _BadRecordError(f"a record of {length} bytes does not fit in the file")
        content = b""
        if opcode in _READ_WHOLE:
            if length > RECORD_LIMIT_BYTES:
                raise _BadRecordError(f"a record of {length} bytes, limit {RECORD_LIMIT_BYTES}")
            content = self._stream.read(length)
            self._add_to_crc(head, content)
            _check_form(opcode, content)
        elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):  # not written by this project; skipped
            self._add_to_crc(head)
            for start in range(0, length, _WINDOW_BYTES):
                self._add_to_crc(self._stream.read(min(_WINDOW_BYTES, length - start)))
        elif opcode == Opcode.MESSAGE:
            raise _BadRecordError("a message outside a chunk carries no checksum; rewrite the log in chunks")
        else:
            raise _BadRecordError(f"no record begins here (code {opcode})")
        return _Record(opcode, content, following)

    def _add_to_crc(self, *pieces: bytes) -> None:
        for piece in pieces:
            if self._crc is not None:
                self._crc = zlib.crc32(piece, self._crc)

    def _check_end(self, offset: int, length: int) -> None:
        """Check that an end mark is the end; a flipped bit can turn another record into an end mark."""
        if length != _DATA_END_BYTES or offset + RECORD_HEAD.size + length > self._size:
            raise _BadRecordError("the end mark is damaged")
        if self.summary is not None and offset != self.summary.data_end:
            raise _BadRecordError("an end mark where the data do not end")
        if self.summary is None:
            if self._next_chunk(offset + RECORD_HEAD.size) is not None:
                raise _BadRecordError("an end mark where the data do not end")
            self._offset(offset, 0, "the index at the end is missing or damaged; no message is lost by that")
        self.is_finished = True
        (crc,) = U32.unpack(self._stream_at(offset + RECORD_HEAD.size, U32.size))
        if crc and self._crc is not None and crc != self._crc:
            self._offset(offset, 0, "the checksum over the whole data does not fit, though each chunk's own does")

    def _stream_at(self, offset: int, n_bytes: int) -> bytes:
        self._stream.seek(offset)
        return self._stream.read(n_bytes)

    def _next_chunk(self, start: int, end: int | None = None) -> int | None:
        """Return the offset of the next intact chunk from `start` on, or None."""
        for offset in self._candidates(start, self._end if end is None else min(end, self._end)):
            head = self._stream_at(offset, RECORD_HEAD.size)
            content = self._stream.read(RECORD_HEAD.unpack(head)[1])
            self._searched += len(content)
            if not self._may_search():
                return None
            before = self._unfolded, self._unfolded_drawn, self._allowance.unfolded_bytes
            try:
                self._uncompress(content)
            except _BadRecordError as bad:
                if bad.foreign:
                    return offset
                continue
            finally:
                self._searched += self._unfolded - before[0]
                self._unfolded, self._unfolded_drawn, self._allowance.unfolded_bytes = before
            return offset
        return None

    def _candidates(self, start: int, end: int) -> Iterator[int]:
        """Yield offsets at which the bytes have the form of a chunk."""
        needed = RECORD_HEAD.size + _SMALLEST_CHUNK_BYTES + len("zstd")
        while start + RECORD_HEAD.size + _SMALLEST_CHUNK_BYTES <= end:
            window = self._stream_at(start, _WINDOW_BYTES)
            if len(window) <= needed:
                window += b"\0" * needed  # padding, so that the form can be checked up to the end
            last = len(window) - needed
            at = window.find(_CHUNK_OPCODE, 0, last)
            while at >= 0:
                if self._has_chunk_form(window, at, start + at):
                    yield start + at
                at = window.find(_CHUNK_OPCODE, at + 1, last)
            start += last

    def _has_chunk_form(self, window: bytes, at: int, offset: int) -> bool:
        _, length = RECORD_HEAD.unpack_from(window, at)
        if not _SMALLEST_CHUNK_BYTES <= length <= min(RECORD_LIMIT_BYTES, self._end - offset - RECORD_HEAD.size):
            return False
        first_ns, last_ns, _, _ = CHUNK_HEAD.unpack_from(window, at + RECORD_HEAD.size)
        position = at + RECORD_HEAD.size + CHUNK_HEAD.size
        (name_bytes,) = U32.unpack_from(window, position)
        if name_bytes > len("zstd") or not first_ns <= last_ns < _TIME_LIMIT_NS:
            return False
        (data_bytes,) = U64.unpack_from(window, position + U32.size + name_bytes)
        return bool(data_bytes == length - _SMALLEST_CHUNK_BYTES - name_bytes)

    def _uncompress(self, content: bytes) -> bytes:
        """Return the records of a chunk; the stream is at the end of the chunk."""
        try:
            _, _, size, crc = CHUNK_HEAD.unpack_from(content)
            compression, position = read_text(content, CHUNK_HEAD.size)
            (length,) = U64.unpack_from(content, position)
        except (struct.error, UnicodeDecodeError) as error:
            raise _BadRecordError(f"a chunk is damaged: {error}") from error
        data = content[position + U64.size :]
        if len(data) != length:  # additional bytes could hide the records that follow
            raise _BadRecordError(f"a chunk is damaged: holds {len(data)} bytes, not the {length} it claims")
        self._check_size(size)
        data = _decompress(data, compression, size)
        if len(data) != size or crc == 0 or zlib.crc32(data) != crc:
            raise _BadRecordError("a chunk is damaged: its checksum does not fit")
        return data

    def _check_size(self, size: int) -> None:
        """Refuse a chunk whose uncompressed size exceeds the share of the file read so far plus the allowance."""
        share = _UNFOLDED_SHARE * self._stream.tell()
        limit = min(RECORD_LIMIT_BYTES, share + self._unfolded_drawn + self._allowance.unfolded_bytes - self._unfolded)
        if size > limit:
            raise _BadRecordError(f"a chunk claims an uncompressed size of {size} bytes, limit {limit}")
        self._unfolded += size
        drawn = max(self._unfolded_drawn, self._unfolded - share)
        self._allowance.unfolded_bytes -= drawn - self._unfolded_drawn
        self._unfolded_drawn = drawn

    def _may_search(self) -> bool:
        """Return whether the search stays within its limits."""
        drawn = max(self._searched_drawn, self._searched - _SEARCH_SHARE * self._size)
        if drawn - self._searched_drawn > self._allowance.searched_bytes:
            return False
        self._allowance.searched_bytes -= drawn - self._searched_drawn
        self._searched_drawn = drawn
        return True


_READ_WHOLE: Final = (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK, Opcode.MESSAGE_INDEX)


def _decompress(data: bytes, compression: str, size: int) -> bytes:
    if not compression:
        return data
    if compression != "zstd":
        raise _BadRecordError(f"a chunk is compressed by {compression!r}; rewrite the log with zstd", foreign=True)
    try:
        if zstandard.frame_content_size(data) not in (size, -1):  # a small chunk could have any uncompressed size
            raise _BadRecordError(f"a chunk is damaged: its length is not the {size} bytes it claims")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except zstandard.ZstdError as error:
        raise _BadRecordError(f"a chunk is damaged: {error}") from error


def _check_form(opcode: int, content: bytes) -> None:
    """Check the lengths within a small record, which has no checksum; a wrong length would skip later records."""
    if opcode == Opcode.CHUNK:
        return
    try:
        if opcode == Opcode.MESSAGE_INDEX:
            end = _end_of_prefixed(content, U16.size)
        elif opcode == Opcode.HEADER:
            end = read_text(content, read_text(content, 0)[1])[1]
        else:  # a schema or channel outside a chunk, which this project does not write
            start = U16.size if opcode == Opcode.SCHEMA else 2 * U16.size
            end = _end_of_prefixed(content, read_text(content, read_text(content, start)[1])[1])
    except (struct.error, UnicodeDecodeError):
        end = -1
    if end != len(content):
        raise _BadRecordError("a record's length does not fit its content")


def _end_of_prefixed(content: bytes, position: int) -> int:
    """Return the offset just past a length-prefixed byte string."""
    return int(position + U32.size + U32.unpack_from(content, position)[0])
