"""A large fleet in parts, simulated drive by drive and kept in files: each robot drives in its own part of a hall."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import fit_transform, se2
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    ObservationFactors,
    OdometryFactors,
    State,
    whitening,
)
from groundsbot.offline.sam.partition.division import ProblemPart, Whole, part_of
from groundsbot.offline.sam.partition.elimination import PartSystem, build
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, solve
from tests.benchmarks.speed import solver_world
from tests.support.paths import ROOT

FLEETS: Final = ROOT / "build" / "fleet_solve"
CROSSINGS: Final = 10  # along each side of the square in which a robot drives
MOST_STRIDE: Final = 7  # crossings between neighbouring squares, so that these overlap

_Factors = TypeVar("_Factors", OdometryFactors, ObservationFactors)


@dataclass(frozen=True)
class FleetFiles:
    """The files of a fleet: a part for each drive, and what joins them."""

    folder: Path
    n_drives: int

    def part(self, drive: int) -> Path:
        return self.folder / f"drive_{drive:03d}.npz"

    @property
    def joined(self) -> Path:
        return self.folder / "joined.npz"


def fleet_files(n_drives: int, n_keyframes: int, n_tags: int, seed: int) -> FleetFiles:
    """The files of a fleet, simulated unless they are there."""
    files = FleetFiles(FLEETS / f"{n_drives}x{n_keyframes}-{n_tags}-seed{seed}", n_drives)
    if not files.joined.is_file():
        files.folder.mkdir(parents=True, exist_ok=True)
        _simulate(files, n_keyframes, n_tags, seed)
    return files


def load_problem(files: FleetFiles) -> tuple[Problem, State]:
    """All drives as one problem, and where it is solved from."""
    whole, start = load_whole(files)
    odometry, observations = zip(*(_factors_of(files.part(drive)) for drive in range(files.n_drives)), strict=True)
    problem = Problem(_joined(odometry), _joined(observations), whole.prior, whole.columns, whole.anchor)
    return problem, start


def load_whole(files: FleetFiles) -> tuple[Whole, State]:
    """What joins the parts, and where they are solved from."""
    with np.load(files.joined) as arrays:
        start = State(arrays["poses"], arrays["tags"], np.zeros(1))
        return _whole(files, len(start.poses), len(start.tags), arrays["anchor"]), start


def load_part(files: FleetFiles, drive: int, n_poses: int, n_tags: int) -> ProblemPart:
    """A drive with numbers of its own, from the number of all poses and tags."""
    whole = _whole(files, n_poses, n_tags, np.zeros(n_tags, dtype=np.int64))
    first, end = whole.segment_start[drive : drive + 2].tolist()
    return part_of(whole, first, end, *_factors_of(files.part(drive)))


def build_part(files: FleetFiles, drive: int, n_poses: int, n_tags: int) -> PartSystem:
    """The same, ready for elimination."""
    return build(load_part(files, drive, n_poses, n_tags))


def _whole(files: FleetFiles, n_poses: int, n_tags: int, anchor: IntArray) -> Whole:
    starts = np.arange(files.n_drives + 1) * (n_poses // files.n_drives)
    columns = solver_world.columns_of(n_poses, n_tags)
    return Whole(columns, anchor, starts, np.arange(n_tags), np.zeros(1, dtype=np.int64), CalibrationPrior(np.zeros(1)))


def _factors_of(path: Path) -> tuple[OdometryFactors, ObservationFactors]:
    """With the numbers of the whole."""
    with np.load(path) as arrays:
        read = dict(arrays)
    return (
        solver_world.odometry_factors(read["first"], read["motion"], read["whitening"]),
        solver_world.observation_factors(read["pose"], read["tag"], read["value"]),
    )


def _joined(kinds: Sequence[_Factors]) -> _Factors:
    arrays = {each.name: np.concatenate([getattr(kind, each.name) for kind in kinds]) for each in fields(kinds[0])}
    return type(kinds[0])(**arrays)


class _Drive(NamedTuple):
    """The measurements of a drive, and its own map in the frame of its start, as `local_map` makes it."""

    motion: FloatArray
    whitening: FloatArray
    pose: IntArray
    tag: IntArray  # number among all tags of the hall
    value: FloatArray
    poses: FloatArray
    own_tags: IntArray
    places: FloatArray


def _simulate(files: FleetFiles, n_keyframes: int, n_tags: int, seed: int) -> None:
    """Writes the files; each drive is laid onto those before by the tags that they share."""
    rng = np.random.default_rng(seed)
    n_side = int(np.ceil(np.sqrt(files.n_drives)))
    n_crossings = max(CROSSINGS, round(np.sqrt(n_tags / 3.0)) + 1)
    hall = solver_world.place_tags(rng, n_crossings, n_tags)
    stride = min(MOST_STRIDE, (n_crossings - CROSSINGS) / max(1, n_side - 1))
    drives = []
    for number in range(files.n_drives):
        drives.append(_simulate_drive(rng, np.round(stride * np.array(divmod(number, n_side))), n_keyframes, hall))
    seen = np.unique(np.concatenate([drive.own_tags for drive in drives]))
    poses, tags, number_of = [], np.full((len(seen), 2), np.nan), np.searchsorted(seen, np.arange(n_tags))
    for number, drive in enumerate(drives):
        own = number_of[drive.own_tags]
        shared = np.isfinite(tags[own, 0])
        T = fit_transform(tags[own[shared]], drive.places[shared]) if number else np.zeros(3)
        tags[own[~shared]] = se2.apply(T, drive.places[~shared])
        poses.append(se2.compose(T, drive.poses))
        first = number * n_keyframes
        np.savez(
            files.part(number), first=first + np.arange(n_keyframes - 1), motion=drive.motion,
            whitening=drive.whitening, pose=first + drive.pose, tag=number_of[drive.tag], value=drive.value,
        )  # fmt: skip
    pose = np.concatenate([number * n_keyframes + drive.pose for number, drive in enumerate(drives)])
    tag = number_of[np.concatenate([drive.tag for drive in drives])]
    anchor = solver_world.middle_observations(pose, tag, len(seen))
    np.savez(files.joined, poses=np.concatenate(poses), tags=tags, anchor=anchor)


def _simulate_drive(rng: np.random.Generator, corner: FloatArray, n_keyframes: int, hall: FloatArray) -> _Drive:
    """Drive between crossings from a corner on, and solve the drive alone, from the truth for speed."""
    poses = solver_world.drive_at_random(rng, CROSSINGS, n_keyframes) + np.append(solver_world.ROAD_M * corner, 0.0)
    first = np.arange(n_keyframes - 1)
    motion, root = solver_world.noisy_motion(rng, poses, first)
    roots = whitening(root @ root.swapaxes(-1, -2))
    low, high = poses[:, :2].min(axis=0) - solver_world.REACH_M, poses[:, :2].max(axis=0) + solver_world.REACH_M
    near = np.flatnonzero(((hall >= low) & (hall <= high)).all(axis=1))
    pose, tag, value = solver_world.observe(rng, poses, hall[near])
    tag = near[tag]
    own_tags, own = np.unique(tag, return_inverse=True)
    problem = Problem(
        solver_world.odometry_factors(first, motion, roots),
        solver_world.observation_factors(pose, own, value),
        CalibrationPrior(np.zeros(1)),
        solver_world.columns_of(n_keyframes, len(own_tags)),
        solver_world.middle_observations(pose, own, len(own_tags)),
    )
    truth = State(se2.between(poses[:1], poses), se2.apply(se2.inverse(poses[0]), hall[own_tags]), np.zeros(1))
    found = solve(problem, truth, 1e-2, PLAIN_SQUARES).state
    return _Drive(motion, roots, pose, tag, value, found.poses, own_tags, found.tags)
