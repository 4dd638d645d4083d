"""Drives whose wheels miss a part of the way, or count one that was not driven."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from groundsbot.calib.foundation.arrays import IntArray
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.measurements.covariance_components import CovarianceParts
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry
from groundsbot.offline.measurements.segment import Segment
from tests.support.data.long_drives import LongDrive, Town, make_long_drive, make_town

NOISE = NoiseParameters()
LENGTH_M = 250.0
PAUSE_S = 10.0  # while the robot is carried


@dataclass(frozen=True)
class BrokenDrive:
    """A drive, and where it broke: one beyond the last keyframe before, and the first one after."""

    drive: LongDrive
    end: int
    begin: int = 0


def make_clean_drive(
    seed: int,
    spacing_m: tuple[float, float] = (3.0, 8.0),
    town: Town | None = None,
    noise: NoiseParameters = NOISE,
) -> LongDrive:
    """A quarter of a kilometre past tags a few metres apart; noise as given."""
    return make_long_drive(
        seed, LENGTH_M, town=town or make_town(1000 + seed, spacing_m), noise=noise, noise_factors=(1.0, 1.0)
    )


def carry(drive: LongDrive, share: float, length_m: float) -> BrokenDrive:
    """After a share of the way the robot is lifted and set down where it would have been some metres on."""
    along_m = np.append(0.0, np.cumsum(drive.segment.odometry.distance_m))
    first = int(np.searchsorted(along_m, share * along_m[-1]))
    begin = int(np.searchsorted(along_m, along_m[first] + length_m))
    segment = drive.segment
    before, after = segment.part(0, first + 1), segment.part(begin, len(segment.stamps_ns))
    still = _motionless(segment.odometry, first)
    return _join(drive, before, after, still, np.r_[0 : first + 1, begin : len(segment.stamps_ns)], PAUSE_S)


def slip(drive: LongDrive, share: float, length_m: float) -> BrokenDrive:
    """After a share of the way the wheels turn on the spot for some metres; nothing is read meanwhile."""
    segment = drive.segment
    first = int(share * len(segment.stamps_ns))
    before, after = segment.part(0, first + 1), segment.part(first, len(segment.stamps_ns))
    # The wheels roll on as they did before.
    along_m = np.append(0.0, np.cumsum(segment.odometry.distance_m))
    begin = int(np.searchsorted(along_m, along_m[first] - length_m))
    spun = segment.odometry.part(begin, first)
    return _join(
        drive,
        before,
        after,
        spun,
        np.r_[0 : first + 1, np.full(len(spun) - 1, first), first : len(segment.stamps_ns)],
        0.25 * len(spun),
    )


def _motionless(odometry: SegmentOdometry, step: int) -> SegmentOdometry:
    """A step in which the wheels stand, known to a tick."""
    one = odometry.part(step, step + 1)
    return replace(
        one,
        motion=np.zeros((1, 3)),
        covariance=1e-6 * np.eye(3)[None],
        parts=replace(one.parts, unit=0.0 * one.parts.unit, rest=1e-6 * np.eye(3)[None]),
        jacobian=np.zeros((1, 3, 3)),
        distance_m=np.zeros(1),
    )


def _join(
    drive: LongDrive, before: Segment, after: Segment, between: SegmentOdometry, pose: IntArray, pause_s: float
) -> BrokenDrive:
    """Two parts with other motions between them for some seconds: len(between) - 1 keyframes without observations."""
    n = len(before.stamps_ns) + len(between) - 1
    tags = tuple(sorted({*before.tags, *after.tags}))
    observations = [
        replace(
            part.observations,
            tag=np.array([tags.index(tag) for tag in part.tags], dtype=np.int64)[part.observations.tag],
            keyframe=part.observations.keyframe + shift,
        )
        for part, shift in ((before, 0), (after, n))
    ]
    first, second = observations
    together = replace(
        first,
        **{
            each.name: np.concatenate([getattr(first, each.name), getattr(second, each.name)])
            for each in fields(first)
            if each.name != "parts"
        },
        parts=_parts([first.parts, second.parts]),
    )
    steps = [before.odometry, between, after.odometry]
    odometry = SegmentOdometry(
        motion=np.concatenate([step.motion for step in steps]),
        covariance=np.concatenate([step.covariance for step in steps]),
        parts=_parts([step.parts for step in steps]),
        jacobian=np.concatenate([step.jacobian for step in steps]),
        distance_m=np.concatenate([step.distance_m for step in steps]),
    )
    n_steps = len(odometry)
    seconds = np.full(n_steps, 0.25)
    seconds[n - len(between) : n] *= pause_s / (0.25 * len(between))
    stamps_ns = drive.segment.stamps_ns[0] + np.rint(np.append(0.0, np.cumsum(seconds)) * 1e9).astype(np.int64)
    segment = replace(drive.segment, stamps_ns=stamps_ns, odometry=odometry, tags=tags, observations=together)
    return BrokenDrive(replace(drive, segment=segment, T_start_base=drive.T_start_base[pose]), len(before.stamps_ns), n)


def _parts(parts: Sequence[CovarianceParts]) -> CovarianceParts:
    first = parts[0]
    return replace(
        first,
        unit=np.concatenate([part.unit for part in parts], axis=1),
        rest=np.concatenate([part.rest for part in parts]),
    )
