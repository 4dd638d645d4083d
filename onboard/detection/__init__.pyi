from .child_process import ChildDetector, DetectionResult, DetectorSettings
from .drawing import draw_board, draw_tags, save_board, save_drawing
from .messages import detections_message, tag_message
from .tag_detector import REFINED_CORNERS, Detection, TagDetector

__all__ = [
    "REFINED_CORNERS",
    "ChildDetector",
    "Detection",
    "DetectionResult",
    "DetectorSettings",
    "TagDetector",
    "detections_message",
    "draw_board",
    "draw_tags",
    "save_board",
    "save_drawing",
    "tag_message",
]
