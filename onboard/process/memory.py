"""Settings of the memory allocator and the garbage collector for a process that runs for hours."""

import ctypes
import gc
from contextlib import suppress
from typing import Final

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # from glibc's malloc.h
_MAPPED_BYTES: Final = 32 << 20  # larger buffers are always returned to the kernel; glibc's largest allowed value
# New container objects after which Python searches for reference cycles. One or two thousand readings wait for the disk
# and have no cycles. With Python's default of 700 they and all libraries would be searched again and again.
_NEW_OBJECTS: Final = 20_000


def keep_memory(kept_bytes: int) -> None:
    """Keep free memory in the process, and exclude all present objects from garbage collection.

    Otherwise the kernel clears a thousand pages for each picture and each chunk of a log, and a full garbage collection
    blocks all threads for 100 ms. Call it once, after all imports.

    Args:
        kept_bytes: largest amount of free memory that the process keeps.
    """
    with suppress(AttributeError):  # a C library other than glibc
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES)
        libc.mallopt(_M_TRIM_THRESHOLD, kept_bytes)
    gc.collect()
    gc.freeze()
    gc.set_threshold(_NEW_OBJECTS, *gc.get_threshold()[1:])
