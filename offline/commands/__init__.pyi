from .drives import calibrate, localize, map_command
from .finished_maps import compare, export
from .imports import import_recording
from .library import compare_map, export_map
from .logs import detect, info, salvage
from .map_drives import MapOptions, make_map
from .map_summary import summary
from .recordings import live

__all__ = [
    "MapOptions",
    "calibrate",
    "compare",
    "compare_map",
    "detect",
    "export",
    "export_map",
    "import_recording",
    "info",
    "live",
    "localize",
    "make_map",
    "map_command",
    "salvage",
    "summary",
]
