"""Maps from two cameras on each robot beside maps of the same drives from either camera alone.

    python -m tests.benchmarks.trust.camera_study [--world room] [--seeds 0-19]

Robots have a camera that looks ahead and one that looks to the left, unrendered, with the calibration drawn. A row a
seed: RMS error of the tags as they stand and aligned, and their NEES; a dash where a camera alone gives several
components. Then the RMSE beside each camera alone, over the seeds that it maps whole. Asked for: aligned tags from both
no worse than from either alone (RMSE over seeds), and 20 % better in `room`; NEES 0.85 to 1.15. Exit 1 where one is
missed.
"""

import argparse
import sys
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import Truth
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.run import Run
from tests.benchmarks.command_line import exit_code, say, seeds_of
from tests.support.data.simulated_runs import simulated_runs

NEES: Final = (0.85, 1.15)
SHARE_IN_ROOM: Final = 0.8
_KINDS: Final = ("both", "front", "left")


class Errors(NamedTuple):
    """Of the tags of one map: RMS as they stand and aligned, and NEES per dimension."""

    tags_m: float
    aligned_m: float
    nees: float


def alone(run: Run, camera: int) -> Run:
    """A run as one of its cameras saw it, with the tags that it saw."""
    one = run.with_camera(camera)
    seen, tag = np.unique(one.detections.tag, return_inverse=True)
    tags = tuple(run.tags[i] for i in seen)
    return replace(one, tags=tags, detections=replace(one.detections, tag=tag))


def map_errors(runs: list[Run], truth: Truth) -> Errors | None:
    """How far off the map of some runs is; None where it has several components, or there is none."""
    try:
        result = build_map(runs)
    except OfflineError:
        return None
    errors = evaluate(result, truth).components[0]
    found = errors.tags_rmse_m, errors.tags_rmse_aligned_m, errors.nees_tags_per_dim
    if len(result.components) > 1 or None in found:
        return None
    return Errors(*(float(each) for each in found if each is not None))


def study_seed(world: str, seed: int) -> dict[str, Errors | None]:
    """The errors of one seed's maps: from both cameras, and from each alone."""
    runs, truth = simulated_runs(world, seed, two_cameras=True)
    views = (runs, *([alone(run, camera) for run in runs] for camera in range(2)))
    return {kind: map_errors(list(view), truth) for kind, view in zip(_KINDS, views, strict=True)}


def missed_bounds(world: str, found: list[dict[str, Errors | None]]) -> list[str]:
    """A sentence for each bound that is missed; says the RMSE over the seeds that both cameras and one alone have."""
    missed = []
    most = SHARE_IN_ROOM if world == "room" else 1.0
    for kind in _KINDS[1:]:
        pairs = [(both, one) for each in found if (both := each["both"]) and (one := each[kind])]
        if not pairs:
            say(f"{kind} alone: several components in all seeds")
            continue
        tags_m, aligned_m, _ = np.sqrt((np.array(pairs) ** 2).mean(axis=0)).T
        n_better = sum(both.aligned_m < one.aligned_m for both, one in pairs)
        say(
            f"both against {kind} alone, {len(pairs)} seeds: RMSE {tags_m[0]:.4f} and {tags_m[1]:.4f} m, aligned "
            f"{aligned_m[0]:.4f} and {aligned_m[1]:.4f} m; better in {n_better}"
        )
        share = aligned_m[0] / aligned_m[1]
        if share > most:
            missed.append(f"aligned tags have {share:.2f} times the error of {kind} alone, at most {most}")
    nees = float(np.mean([each["both"].nees for each in found if each["both"] is not None]))
    say(f"both: NEES {nees:.2f}, mean of all seeds")
    if not NEES[0] <= nees <= NEES[1]:
        missed.append(f"NEES {nees:.2f}, {NEES[0]} to {NEES[1]}")
    return missed


def main() -> int:
    """The script: 0 where every bound holds, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="room", help="name or file of a world [room]")
    parser.add_argument("--seeds", type=seeds_of, default=range(20), help="FIRST-LAST or one seed [0-19]")
    given = parser.parse_args()
    found = []
    for seed in given.seeds:
        found.append(study_seed(given.world, seed))
        say(f"seed {seed}: " + "; ".join(f"{kind} {_words(each)}" for kind, each in found[-1].items()))
    return exit_code(missed_bounds(given.world, found))


def _words(errors: Errors | None) -> str:
    if errors is None:
        return "-"
    return f"{errors.tags_m:.4f} m, aligned {errors.aligned_m:.4f} m, NEES {errors.nees:.2f}"


if __name__ == "__main__":
    sys.exit(main())
