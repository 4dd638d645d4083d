"""Which pictures of a drive become keyframes, the poses of the state."""

from math import dist
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.run import Run

# A picture becomes a keyframe when the robot has moved this much since the last one, or shows a tag which that did not;
KEYFRAME_DISTANCE_M: Final = 0.02
KEYFRAME_TURN_RAD: Final = np.radians(1.0)
# it is one more look from the same standing pose when neither wheel has moved by more than a flicker of its encoder: a
# look from a pose that is but a millimetre or a tenth of a degree off would already be wrong by several sigmas.
_STANDING_TICKS: Final = 1.5
_STANDING_M: Final = 1e-7  # rounding


def candidate_stamps(run: Run, wheel_segment: WheelSegment) -> IntArray:
    """Times at which a pose is wanted: pictures, or whatever an imported log was stamped with."""
    stamps_ns = run.picture_stamps_ns
    if not len(stamps_ns):
        stamps_ns = np.union1d(wheel_segment.stamps_ns, run.positions.stamps_ns)
    inside = (stamps_ns >= wheel_segment.stamps_ns[0]) & (stamps_ns <= wheel_segment.stamps_ns[-1])
    return np.asarray(np.union1d(wheel_segment.stamps_ns[:1], stamps_ns[inside]), dtype=np.int64)


def tags_at_candidates(run: Run, stamps_ns: IntArray) -> list[set[int]]:
    """The tags that each candidate shows."""
    tags_at: list[set[int]] = [set() for _ in stamps_ns]
    indices = np.arange(len(stamps_ns))
    for source in (run.detections, run.positions):
        at = keyframe_at(source.stamps_ns, stamps_ns, indices)
        for candidate, tag in zip(at.tolist(), source.tag.tolist(), strict=True):
            if candidate >= 0:
                tags_at[candidate].add(tag)
    return tags_at


def choose_keyframes(
    wheel_segment: WheelSegment, stamps_ns: IntArray, tags_at: list[set[int]], track_m: float
) -> tuple[IntArray, IntArray]:
    """Thins by motion: (K,) stamps, and for each candidate its keyframe or -1 (passed over)."""
    left_m, right_m = wheel_segment.at(stamps_ns)
    place_m = np.stack([0.5 * (left_m + right_m), wheel_segment.lateral_at(stamps_ns)], axis=-1).tolist()
    turn_rad = (right_m - left_m) / track_m
    keyframe_of = np.full(len(stamps_ns), -1, dtype=np.int64)
    standing_m = _STANDING_TICKS * wheel_segment.quantum_m + _STANDING_M
    chosen: list[int] = []
    for i, (place, turn) in enumerate(zip(place_m, turn_rad.tolist(), strict=True)):
        moved_m = dist(place, place_m[chosen[-1]]) if chosen else np.inf
        turned_rad = abs(turn - turn_rad[chosen[-1]]) if chosen else np.inf
        standing = moved_m + 0.5 * track_m * turned_rad <= standing_m  # the wheel that moved more
        moved = moved_m >= KEYFRAME_DISTANCE_M or turned_rad >= KEYFRAME_TURN_RAD
        if moved or (not standing and tags_at[i] - tags_at[chosen[-1]]):
            chosen.append(i)
        elif not standing:
            continue
        keyframe_of[i] = len(chosen) - 1
    return stamps_ns[chosen], keyframe_of


def keyframe_at(wanted_ns: IntArray, stamps_ns: IntArray, keyframe_of: IntArray) -> IntArray:
    """Keyframe of each wanted stamp, -1 where it is none of the candidates."""
    at = np.minimum(np.searchsorted(stamps_ns, wanted_ns), len(stamps_ns) - 1)
    return np.where(stamps_ns[at] == wanted_ns, keyframe_of[at], -1)
