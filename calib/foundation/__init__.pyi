from .arrays import BoolArray, FloatArray, IndexArray, IntArray
from .command_line import EXIT_DONE, EXIT_REFUSED, EXIT_WITH_LOSSES, echo, new_app, run
from .error_function import erf
from .files import StrPath, atomic_write, folder_written_whole, read_regular, sync
from .help_pages import GroupedOptions
from .picture_bytes import JPEG_END, MOST_PICTURE_BYTES, MOST_PIXELS, is_complete, is_jpeg, size_in_header
from .words import plural, printable
from .yaml_file import parse_mapping, read_text, validate, write_model

__all__ = [
    "EXIT_DONE",
    "EXIT_REFUSED",
    "EXIT_WITH_LOSSES",
    "JPEG_END",
    "MOST_PICTURE_BYTES",
    "MOST_PIXELS",
    "BoolArray",
    "FloatArray",
    "GroupedOptions",
    "IndexArray",
    "IntArray",
    "StrPath",
    "atomic_write",
    "echo",
    "erf",
    "folder_written_whole",
    "is_complete",
    "is_jpeg",
    "new_app",
    "parse_mapping",
    "plural",
    "printable",
    "read_regular",
    "read_text",
    "run",
    "size_in_header",
    "sync",
    "validate",
    "write_model",
]
