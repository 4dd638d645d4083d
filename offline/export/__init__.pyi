from .export import export_map
from .options import ExportFormat, ExportOptions

__all__ = [
    "ExportFormat",
    "ExportOptions",
    "export_map",
]
