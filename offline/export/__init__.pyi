from .export import export_map
from .options import ExportFormat, ExportOptions, LayoutForm

__all__ = [
    "ExportFormat",
    "ExportOptions",
    "LayoutForm",
    "export_map",
]
