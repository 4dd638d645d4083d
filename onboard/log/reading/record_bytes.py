"""Binary fields of MCAP records."""

import struct
from typing import Final

RECORD_HEAD: Final = struct.Struct("<BQ")  # code, length
CHUNK_HEAD: Final = struct.Struct("<QQQI")  # first and last time, size uncompressed, its CRC-32
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
U16: Final = struct.Struct("<H")
U32: Final = struct.Struct("<I")
U64: Final = struct.Struct("<Q")


def read_text(data: bytes, position: int) -> tuple[str, int]:
    """Return a length-prefixed text, and the position where it ends.

    Raises:
        struct.error: the text does not fit in the data.
        UnicodeDecodeError: the text is not UTF-8.
    """
    (length,) = U32.unpack_from(data, position)
    start = position + U32.size
    if start + length > len(data):
        raise struct.error("a text does not fit in its record")
    return data[start : start + length].decode(), start + length
