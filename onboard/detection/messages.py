"""Detections as messages of the log."""

from collections.abc import Sequence

from groundsbot.onboard.detection.tag_detector import Detection
from groundsbot.onboard.log import StampSource, TagDetection, TagDetections


def detections_message(
    detections: Sequence[Detection],
    size_px: tuple[int, int],
    stamp_ns: int,
    source: "StampSource | int",
    sequence: int,
    detector: str,
    detector_settings: str,
) -> TagDetections:
    """Return the message of the tags of one picture, without the wheel sequence, which is set later."""
    return TagDetections(
        stamp_ns=stamp_ns,
        frame_sequence=sequence,
        width_px=size_px[0],
        height_px=size_px[1],
        detector=detector,
        detector_settings=detector_settings,
        stamp_source=StampSource.Name(source),
        detections=[tag_message(each) for each in detections],
    )


def tag_message(each: Detection) -> TagDetection:
    """Return the message of one tag."""
    return TagDetection(
        family=each.family,
        tag_id=each.tag_id,
        hamming=each.hamming,
        decision_margin=each.decision_margin,
        corners_px=each.corners_px.ravel().tolist(),
    )
