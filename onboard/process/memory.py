"""How a process that runs for hours keeps its memory: it neither gives it back each time nor searches it in vain."""

import ctypes
import gc
from contextlib import suppress
from typing import Final

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_MAPPED_BYTES: Final = 32 << 20  # buffers from here on go back in any case; the most that glibc lets one ask for
# Python searches for rings of dead objects after so many new ones that hold others. Readings on their way to the disk
# are a thousand or two, and no ring: by its own 700 it would search them, and all of the libraries, again and again.
_NEW_OBJECTS: Final = 20_000


def keep_memory(kept_bytes: int) -> None:
    """What is free stays for the next picture or chunk; what is there now is taken to stay for ever.

    The kernel would clear a thousand pages for each picture and each piece of a log, and a search through all objects
    would hold up every thread for 100 ms. Call it once, when what the process needs has been imported.

    Args:
        kept_bytes: how much free memory may stay with the process.
    """
    with suppress(AttributeError):  # a C library without it
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES)
        libc.mallopt(_M_TRIM_THRESHOLD, kept_bytes)
    gc.collect()
    gc.freeze()
    gc.set_threshold(_NEW_OBJECTS, *gc.get_threshold()[1:])
