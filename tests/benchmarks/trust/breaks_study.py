"""Drives whose odometry broke: how often that is found, where, how accurate the map is; and false alarms.

    nice python -m tests.benchmarks.trust.breaks_study --seeds 0-99 [--gyro]

A quarter of a kilometre past tags 3 to 8 m apart; calibration drawn from its priors, noise as given. After 55 % of the
way the robot is carried on by 2 m (`carry`) or round a corner (`turned`), or its wheels turn on the spot for 3 m
(`slip`); or nothing of the kind happens (`clean`). A break can be found by the drive's own tags where two of them are
on both sides and agree, and contradict the wheels: where the parts, cut at the true place, have an accepted alignment,
and keeping the motion there costs more than is met once in a thousand drives (chi-square with 3 degrees of freedom,
all observations counted as places). A slip of 3 m on the way back to a tag a hundred metres on costs next to nothing:
headings wander by more. With `--gyro` the heading has the noise of a gyro's turns at 0.5 m/s instead of the wheels',
but the gyro does not see how the robot is turned while it is carried. Map errors are RMS over the tags of the segments
laid over the truth, and the same of two runs, cut at the true place.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.geometry import se2
from groundsbot.calib.geometry.se2 import fit_transform
from groundsbot.calib.robot import Gyro
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.condensed_map import condense
from groundsbot.offline.alignment.merging import merge
from groundsbot.offline.alignment.pairwise import align
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.outliers.grown_segments import FALSE_ALARM
from groundsbot.offline.outliers.split_drives import split_at_breaks
from groundsbot.offline.sam.solver import solve
from tests.benchmarks.command_line import seeds_of
from tests.support.data.broken_odometry import NOISE, BrokenDrive, carry, make_clean_drive, slip

_FREED: Final = 1e-4  # of a motion's whitening
_PER_SQRT_M = Gyro().noise_rad_per_sqrt_s * 0.5**-0.5
_WITH_GYRO: Final = NOISE.model_copy(
    update={"sigma_heading_rad_per_sqrt_m": _PER_SQRT_M, "sigma_heading_rad_per_sqrt_rad": _PER_SQRT_M}
)
KINDS: Final = ("clean", "carried", "turned", "slipped")


@dataclass(frozen=True)
class Outcome:
    """Of one drive.

    Attributes:
        can_be_told: two tags agree on it, and it costs more than chance.
        n_segments: that came out.
        rms_m: of the tags; of those of two runs in `two_runs_rms_m`.
        said: the warnings.
    """

    kind: str
    seed: int
    can_be_told: bool
    n_segments: int
    rms_m: float
    two_runs_rms_m: float
    said: tuple[str, ...]


def broken_drive(kind: str, seed: int, noise: NoiseParameters = NOISE) -> BrokenDrive:
    """A drive of a kind."""
    drive = make_clean_drive(seed, noise=noise)
    if kind == "carried":
        return carry(drive, 0.55, 2.0)
    if kind == "turned":
        return carry(drive, 0.496, 2.0)  # a crossing is at 125 m
    if kind == "slipped":
        return slip(drive, 0.55, 3.0)
    return BrokenDrive(drive, len(drive.segment.stamps_ns))


def outcome_of(kind: str, seed: int, noise: NoiseParameters = NOISE) -> Outcome:
    """What becomes of one drive."""
    broken = broken_drive(kind, seed, noise)
    segment = broken.drive.segment
    whole = solve_local_map(segment)
    mended = split_at_breaks([whole])
    two_runs, can_be_told = [whole], False
    if kind != "clean":
        ends = (0, broken.end), (broken.begin, len(segment.stamps_ns))
        two_runs = [solve_local_map(replace(segment.part(*part), name=f"{segment.name}{part[0]}")) for part in ends]
        can_be_told = _align_for_sure(*two_runs) and _costs_more_than_chance(whole, broken)
    return Outcome(
        kind, seed, can_be_told, len(mended.maps), _rms_m(mended.maps, broken), _rms_m(two_runs, broken),
        tuple(mended.warnings),
    )  # fmt: skip


def _costs_more_than_chance(whole: LocalMap, broken: BrokenDrive) -> bool:
    """Whether the motion over the true place contradicts all else, given where it is."""
    problem, state = whole.graph.problem, whole.solution.state
    odometry = problem.odometry
    inside = (odometry.first >= broken.end - 1) & (odometry.first < broken.begin)
    weak = np.where(inside[:, None, None], _FREED, 1.0) * odometry.whitening
    apart = solve(problem.reweigh(weak, problem.observations.whitening), state)
    joined = min(whole.solution.cost, solve(problem, apart.state).cost)
    n_places = len(np.unique(whole.segment.observations.keyframe))
    return 2.0 * (joined - apart.cost) > float(chi2.isf(FALSE_ALARM / n_places, 3))


def _align_for_sure(before: LocalMap, after: LocalMap) -> bool:
    shared = sorted(set(before.graph.tags) & set(after.graph.tags))
    alignment = align(condense(before, shared), condense(after, shared)) if len(shared) > 1 else None
    return alignment is not None and alignment.is_accepted


def _rms_m(maps: Sequence[LocalMap], broken: BrokenDrive) -> float:
    """Of the tags of the largest component, laid over the truth."""
    graph, solution = solve_global_map(maps, merge(maps).groups[0], Stages())
    truth = np.array([broken.drive.tags_m[tag] for tag in graph.tags])
    found = solution.state.tags
    off = se2.apply(fit_transform(truth, found), found) - truth
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def summary(outcomes: Sequence[Outcome]) -> str:
    """The result of one kind as text."""
    told = [each for each in outcomes if each.can_be_told]
    found = [each for each in told if each.n_segments > 1]
    split = sum(each.n_segments > 1 for each in outcomes)
    text = f"{outcomes[0].kind}: {split} of {len(outcomes)} drives split"
    if not told:
        return text
    ratio = np.array([each.rms_m / each.two_runs_rms_m for each in found])
    return (
        f"{text}; of {len(told)} that two tags tell of, {len(found)} found; their map's error over that of two runs: "
        f"median {np.median(ratio):.2f}, more than 1.5 in {(ratio > 1.5).sum()}"
    )


def main() -> int:
    """Runs what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, default="0-19")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--gyro", action="store_true", help="headings are as uncertain as by a gyro")
    arguments = parser.parse_args()
    noise = _WITH_GYRO if arguments.gyro else NOISE
    for kind in arguments.kinds:
        outcomes = []
        for seed in arguments.seeds:
            outcomes.append(outcome_of(kind, seed, noise))
            sys.stdout.write(f"{outcomes[-1]}\n")
            sys.stdout.flush()
        sys.stdout.write(summary(outcomes) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
