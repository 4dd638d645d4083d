from .capture import Capture, summary
from .guide import Advice, CaptureGuide
from .view import CaptureView

__all__ = [
    "Advice",
    "Capture",
    "CaptureGuide",
    "CaptureView",
    "summary",
]
