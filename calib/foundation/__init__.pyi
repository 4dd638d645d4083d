from .arrays import BoolArray, FloatArray, IntArray
from .command_line import EXIT_DONE, EXIT_REFUSED, EXIT_WITH_LOSSES, new_app, run
from .files import folder_written_whole, sync, written_whole
from .picture_bytes import JPEG_END, MOST_PIXELS, claimed_size, is_complete, is_jpeg
from .words import counted
from .yaml_file import parse_mapping, read_text, validated, write_model

__all__ = [
    "EXIT_DONE",
    "EXIT_REFUSED",
    "EXIT_WITH_LOSSES",
    "JPEG_END",
    "MOST_PIXELS",
    "BoolArray",
    "FloatArray",
    "IntArray",
    "claimed_size",
    "counted",
    "folder_written_whole",
    "is_complete",
    "is_jpeg",
    "new_app",
    "parse_mapping",
    "read_text",
    "run",
    "sync",
    "validated",
    "write_model",
    "written_whole",
]
