"""Two runs that share one tag, joined over it: how often, and whether the transform knows its errors.

    python -m tests.benchmarks.trust.tag_join_study --seeds 0-29

Drives a and c of the world `room` without rendering; of the tags that both saw all but one are taken from c, each in
turn that both saw often enough to be any use. Prints each map, and the mean NEES of the transform over its three
numbers beside where 99.9 % of such means lie. Exit 1 where it lies outside, or a map was joined wrongly: beyond what
happens once in 10,000 times.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.evaluation.truth import Truth
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run
from tests.benchmarks.command_line import seeds_of
from tests.support.data.simulated_runs import simulated_runs

_LEAST_LOOKS = 5


@dataclass(frozen=True)
class Joined:
    """One map of two runs that share one tag."""

    seed: int
    tag_id: int
    reason: str  # why it is in parts, empty where it is not
    nees: float  # of the transform, over its three numbers
    sigma_rad: float


def without_tags(run: Run, tag_ids: set[int]) -> Run:
    """The run as if it had not seen some tags."""
    kept = ~np.isin([run.tags[i].tag_id for i in run.detections.tag], list(tag_ids))
    found = run.detections
    return replace(run, detections=found.where(kept))


def looks(run: Run) -> dict[int, int]:
    """How many pictures show each tag."""
    return {tag.tag_id: int((run.detections.tag == i).sum()) for i, tag in enumerate(run.tags)}


def transform_error(result: MapResult, truth: Truth) -> tuple[FloatArray, FloatArray]:
    """(3,) x, y, theta that the only alignment's transform is off, in the first run's frame, and its covariance."""
    (alignment,) = result.alignments
    starts = [truth.runs[name].T_world_base[0] for name in (alignment.from_run, alignment.to_run)]
    off = alignment.T_from_to - se2.between(starts[0], starts[1])
    assert alignment.covariance is not None
    return np.append(off[:2], se2.wrap_angle(off[2])), alignment.covariance


def study_seed(seed: int) -> Iterator[Joined]:
    """One map for each tag that both saw."""
    (one, other), truth = simulated_runs("room", seed, ["a", "c"])
    seen = looks(one), looks(other)
    shared = {tag for tag in seen[0] if min(each.get(tag, 0) for each in seen) > 0}
    for tag in sorted(shared):
        if min(each[tag] for each in seen) < _LEAST_LOOKS:
            continue
        result = build_map([one, without_tags(other, shared - {tag})], corners=True)
        if len(result.components) > 1:
            told = [warning for warning in result.warnings if warning.startswith("component 2")]
            yield Joined(seed, tag, told[0], np.nan, np.nan)
            continue
        off, covariance = transform_error(result, truth)
        nees = float(off @ np.linalg.solve(covariance, off)) / 3.0
        yield Joined(seed, tag, "", nees, float(covariance[2, 2] ** 0.5))


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where the transform is consistent and nothing is joined wrongly."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, default="0-29", help="[0-29]")
    nees = []
    for seed in parser.parse_args(arguments).seeds:
        for each in study_seed(seed):
            told = each.reason or f"NEES {each.nees:.2f}, heading {np.degrees(each.sigma_rad):.2f} deg"
            sys.stdout.write(f"seed {seed}, tag {each.tag_id}: {told}\n")
            sys.stdout.flush()
            if not each.reason:
                nees.append(each.nees)
    n = len(nees)
    low, high = (float(chi2.ppf(share, 3 * n)) / (3 * n) for share in (0.0005, 0.9995))
    mean, worst = float(np.mean(nees)), max(nees)
    sys.stdout.write(f"{n} joined: mean NEES {mean:.3f} (99.9 %: {low:.3f} to {high:.3f}), largest {worst:.2f}\n")
    return int(not low < mean < high or 3.0 * worst > chi2.isf(1e-4, 3))


if __name__ == "__main__":
    sys.exit(main())
