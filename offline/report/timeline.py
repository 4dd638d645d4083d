"""Each drive over time: speed, tags in view, residuals of its observations, gaps and events."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.measurements import RunEvent, Segment, speed_profile

_S: Final = 1e-9


def timeline(segment: Segment, residuals: FloatArray, events: Sequence[RunEvent], most_points: int) -> dict[str, Any]:
    """Return one segment's columns over time, thinned: means of speed, maxima of the others.

    Args:
        segment: segment whose keyframes give the times of tags and residuals.
        residuals: (M,) residual of each of its observations, 1 as expected.
        events: events from `events_of`.
        most_points: largest number of points in a column.
    """
    profile = segment.speeds or speed_profile(segment.run, segment.stamps_ns, segment.along_m, most_points)
    n = len(segment.stamps_ns)
    n_observations = np.bincount(segment.observations.keyframe, minlength=n)
    # A keyframe at which the robot stood has several observations of a tag.
    seen = np.unique(np.stack([segment.observations.keyframe, segment.observations.tag]), axis=1)
    n_tags = np.bincount(seen[0], minlength=n)
    squares = np.bincount(segment.observations.keyframe, residuals**2, n)
    worst = np.zeros(n)
    np.maximum.at(worst, segment.observations.keyframe, residuals)
    first = np.arange(0, n, -(-n // most_points))
    observations = np.add.reduceat(n_observations, first)
    return {
        "run": segment.name,
        "t_s": seconds_since(segment.stamps_ns[0], segment.stamps_ns[first]),
        "speed": {"step_s": round(profile.step_s, 6), "m_s": np.round(profile.m_s, 3).tolist()},
        "tags": np.maximum.reduceat(n_tags, first).tolist(),
        "rms": _mean_or_none(np.add.reduceat(squares, first), observations, 4, root=True),
        "worst": _mean_or_none(
            np.where(observations > 0, np.maximum.reduceat(worst, first), 0.0), observations.clip(0, 1), 2
        ),
        "gaps": np.round((profile.gaps_ns - segment.stamps_ns[0]) * _S, 2).tolist(),
        "events": [_event_entry(event, segment) for event in events],
    }


def seconds_since(start_ns: int, stamps_ns: IntArray) -> list[float]:
    """Return times (N,) in seconds after the start, to hundredths."""
    seconds: list[float] = np.round((stamps_ns - start_ns) * _S, 2).tolist()
    return seconds


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


def _event_entry(event: RunEvent, segment: Segment) -> dict[str, Any]:
    """Return an event at its time, limited to the drive."""
    at_ns = min(max(event.stamp_ns, int(segment.stamps_ns[0])), int(segment.stamps_ns[-1])) - int(segment.stamps_ns[0])
    return {"t_s": round(at_ns * _S, 2), "loss": event.is_loss, "text": event.text}
