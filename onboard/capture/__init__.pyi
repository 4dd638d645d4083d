from .capture import Capture, summary
from .guide import CaptureGuide
from .view import CaptureView

__all__ = [
    "Capture",
    "CaptureGuide",
    "CaptureView",
    "summary",
]
