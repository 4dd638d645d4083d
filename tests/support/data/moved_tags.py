"""Towns in which tags are moved, doubled and swapped between drives or during one, and the drives; no logs.

Small towns of four roads with forty tags, which a drive of 150 m passes most of; an observation every half metre.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.measurements.segment import Segment
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.outliers.places import NOWHERE, Places
from tests.support.data.drives import FAMILY, S
from tests.support.data.long_drives import LongDrive, Town, make_long_drive, make_town

N_TAGS: Final = 40
N_RUNS: Final = 4
LENGTH_M: Final = 150.0
_EVERY: Final = 10  # steps of 5 cm or 5 degrees between pictures
_SPACING_M: Final = (1.6, 2.4)
_AN_HOUR_NS: Final = 3600 * S

CLEAN: Final = "clean"
MOVED: Final = "moved"
MOVING: Final = "moving"
SWAPPED: Final = "swapped"
DUPLICATED: Final = "duplicated"


@dataclass(frozen=True)
class Scene:
    """The drives of one trial.

    Attributes:
        drives: one after the other, an hour apart.
        kind: what was done.
        ids: to these tags.
        first_m: (N_TAGS, 2) in the town, by id, where each tag is at first.
        other_m: likewise the other place of the tags with these ids; NaN for the rest.
    """

    drives: tuple[LongDrive, ...]
    kind: str
    ids: tuple[int, ...]
    first_m: FloatArray
    other_m: FloatArray

    def is_other(self, run: int, tag_id: int) -> BoolArray:
        """(M,) of the observations of an id in a run: which are of its other place, by the true poses."""
        drive = self.drives[run]
        own = drive.segment.observations.tag == drive.segment.tags.index(TagKey(FAMILY, tag_id))
        poses = se2.compose(drive.T_town_start, drive.T_start_base)[drive.segment.observations.keyframe[own]]
        seen = se2.apply(se2.compose(poses, drive.segment.T_base_sensor[0]), _places(drive.segment, own))
        far = np.linalg.norm(seen - self.first_m[tag_id], axis=1)
        return np.asarray(np.linalg.norm(seen - self.other_m[tag_id], axis=1) < far)


def make_scene(seed: int, kind: str = CLEAN, n_tags: int = 0, shift_m: float = 0.0) -> Scene:
    """Four drives; what is done is done after the second, or halfway through it to moving tags.

    Args:
        seed: of everything.
        kind: of what is done; to doubles it was done before the first.
        n_tags: how many tags are moved, or how many pairs swapped or given one id.
        shift_m: how far tags are moved.
    """
    town = _town(seed)
    rng = np.random.default_rng([seed, 1])
    chosen = rng.permutation(N_TAGS)[: 2 * n_tags]
    other_m = np.full((N_TAGS, 2), np.nan)
    own, partner = chosen[:n_tags], chosen[n_tags:]
    towns = [town] * N_RUNS
    if kind in (MOVED, MOVING):
        angle = rng.uniform(-np.pi, np.pi, n_tags)
        other_m[own] = town.tags_m[own] + shift_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        towns[2:] = [_with(town, own, other_m[own])] * 2
        if kind == MOVING:
            towns[1] = _during(town, own, other_m[own])
    elif kind == SWAPPED:
        own = np.concatenate([own, partner])
        other_m[own] = town.tags_m[np.roll(own, n_tags)]
        towns[2:] = [_with(town, own, other_m[own])] * 2
    elif kind == DUPLICATED:
        other_m[own] = town.tags_m[partner]
        ids = np.arange(N_TAGS)
        ids[partner] = own
        towns = [replace(town, tag_ids=ids)] * N_RUNS
    drives = tuple(
        _later(
            make_long_drive(
                1000 * seed + i, LENGTH_M, _EVERY, town=each, noise=NoiseParameters(), noise_factors=(1.0, 1.0)
            ),
            i,
        )
        for i, each in enumerate(towns)
    )
    return Scene(drives, kind, tuple(own.tolist()), town.tags_m, other_m)


def without(segment: Segment, ids: Sequence[int]) -> Segment:
    """The same drive past a town that does not have these tags."""
    kept = np.array([tag.tag_id not in ids for tag in segment.tags], dtype=np.bool_)
    observations = segment.observations.where(kept[segment.observations.tag])
    number = np.cumsum(kept) - 1
    tags = tuple(tag for tag, keep in zip(segment.tags, kept.tolist(), strict=True) if keep)
    return replace(segment, tags=tags, observations=replace(observations, tag=number[observations.tag]))


def _town(seed: int) -> Town:
    """Of the towns with so many tags at least, the first N_TAGS, in any order."""
    rng = np.random.default_rng([seed, 0])
    while True:
        town = make_town(int(rng.integers(2**31)), _SPACING_M, n_crossings=2)
        if len(town.tags_m) >= N_TAGS:
            return replace(town, tags_m=town.tags_m[rng.permutation(len(town.tags_m))[:N_TAGS]])


def _with(town: Town, ids: IntArray, places_m: FloatArray) -> Town:
    tags_m = town.tags_m.copy()
    tags_m[ids] = places_m
    return replace(town, tags_m=tags_m)


def _during(town: Town, ids: IntArray, places_m: FloatArray) -> Town:
    """First here, then there."""
    there = np.tile([0.0, 2.0], (N_TAGS + len(ids), 1))
    there[ids, 1] = 0.5
    there[N_TAGS:, 0] = 0.5
    return replace(
        town, tags_m=np.concatenate([town.tags_m, places_m]), tag_ids=np.append(np.arange(N_TAGS), ids), there=there
    )


def _later(drive: LongDrive, hours: int) -> LongDrive:
    """Driven some hours later: so the order of drives is known."""
    late_ns = hours * _AN_HOUR_NS
    return replace(drive, segment=replace(drive.segment, stamps_ns=drive.segment.stamps_ns + late_ns))


def _places(segment: Segment, own: BoolArray) -> FloatArray:
    """(M, 2) in the camera's axes; all observations of long drives are polar."""
    range_m, bearing_rad = segment.observations.value[own].T
    return np.stack([range_m * np.cos(bearing_rad), range_m * np.sin(bearing_rad)], axis=-1)


def gain_of(places: Places, members: IntArray) -> tuple[float, FloatArray]:
    """What it brings to give some tracks (indices) a place of their own, in squared sigmas; and its information."""
    inner, own = places.stiffness.together(members), places.gradient[members].sum(axis=0)
    return float(own @ np.linalg.solve(inner + NOWHERE * np.eye(2), own)), inner
