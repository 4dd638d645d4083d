"""Each drive over time: speed, tags in view, residuals of its observations, gaps and events."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.measurements import GAP_NS, RunEvent, Segment

# About the width of a screen in pixels.
_MOST_POINTS: Final = 800
_S: Final = 1e-9


def timeline(segment: Segment, residual_sigmas: FloatArray, events: Sequence[RunEvent]) -> dict[str, Any]:
    """Return one segment's columns over time, thinned: means of speed, maxima of the others.

    Args:
        segment: whose keyframes give the times.
        residual_sigmas: (M,) residual of each of its observations, in sigmas per coordinate.
        events: from `events_of`.
    """
    n = len(segment.stamps_ns)
    seconds = (segment.stamps_ns - segment.stamps_ns[0]) * _S
    n_tags = np.bincount(segment.observations.keyframe, minlength=n)
    squares = np.bincount(segment.observations.keyframe, residual_sigmas**2, n)
    worst = np.zeros(n)
    np.maximum.at(worst, segment.observations.keyframe, residual_sigmas)
    first = np.arange(0, n, -(-n // _MOST_POINTS))
    observations = np.add.reduceat(n_tags, first)
    # A run of a single keyframe has no speed.
    step_m = np.append(segment.odometry.distance_m, 0.0)
    step_s = np.append(np.diff(seconds), 0.0)
    driven_m, lasting_s = np.add.reduceat(step_m, first), np.add.reduceat(step_s, first)
    return {
        "run": segment.name,
        "t_s": np.round(seconds[first], 2).tolist(),
        "speed_m_s": _mean_or_none(driven_m, lasting_s, 3),
        "tags": np.maximum.reduceat(n_tags, first).tolist(),
        "rms": _mean_or_none(np.add.reduceat(squares, first), observations, 4, root=True),
        "worst": _mean_or_none(
            np.where(observations > 0, np.maximum.reduceat(worst, first), 0.0), observations.clip(0, 1), 2
        ),
        "gaps": _gaps(segment),
        "events": [_event_entry(event, segment) for event in events],
    }


def _mean_or_none(
    total: FloatArray, count: FloatArray | IntArray, digits: int, *, root: bool = False
) -> list[float | None]:
    """Return total by count, None for a count of zero."""
    mean = total / np.where(count > 0, count, 1)
    values = np.round(np.sqrt(mean) if root else mean, digits).tolist()
    return [value if known else None for value, known in zip(values, (count > 0).tolist(), strict=True)]


def events_of(segments: Sequence[Segment]) -> dict[str, list[RunEvent]]:
    """Return recorders' events by the name of the segment at that time or, between two of them, the nearest."""
    told: dict[str, list[RunEvent]] = {segment.name: [] for segment in segments}
    for name in dict.fromkeys(segment.run.name for segment in segments):
        own = [segment for segment in segments if segment.run.name == name]
        spans = [(int(segment.stamps_ns[0]), int(segment.stamps_ns[-1])) for segment in own]
        for event in own[0].run.events:
            away_ns = [max(first - event.stamp_ns, event.stamp_ns - last, 0) for first, last in spans]
            told[own[away_ns.index(min(away_ns))].name].append(event)
    return told


def _gaps(segment: Segment) -> list[list[float]]:
    """Return begin and end in seconds of gaps between wheel readings that are longer than allowed."""
    if not segment.run.wheel_segments:  # from an archived map: only its log has them
        return []
    stamps_ns = np.concatenate([wheel_segment.stamps_ns for wheel_segment in segment.run.wheel_segments])
    stamps_ns = stamps_ns[(stamps_ns >= segment.stamps_ns[0]) & (stamps_ns <= segment.stamps_ns[-1])]
    before = np.flatnonzero(np.diff(stamps_ns) > GAP_NS)
    begin_s, end_s = ((stamps_ns[i] - segment.stamps_ns[0]) * _S for i in (before, before + 1))
    gaps: list[list[float]] = np.round(np.stack([begin_s, end_s], axis=-1), 2).tolist()
    return gaps


def _event_entry(event: RunEvent, segment: Segment) -> dict[str, Any]:
    """Return an event at its time, limited to the drive."""
    at_ns = min(max(event.stamp_ns, int(segment.stamps_ns[0])), int(segment.stamps_ns[-1])) - int(segment.stamps_ns[0])
    return {"t_s": round(at_ns * _S, 2), "loss": event.is_loss, "text": event.text}
