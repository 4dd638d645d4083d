"""How often tags that were moved, doubled or swapped are named, and how often others are.

    python -m tests.benchmarks.suspects_study [--trials 200] [--kinds clean,moved,...] [--output FOLDER]

Forty tags, four runs: one to five tags moved between the runs, by 0.1, 0.3 or 1 m; moved while a run passes by; ids
given twice; pairs swapped; and nothing done. A tag counts as seen if the readings hold it on both sides of the change
and their covariance, all else as it was, foretells the shift to better than a sixth of it. The map that remains is
compared with that of the same runs without the tags in question. Exit 1 where a bound is missed.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from calib import se2
from calib.arrays import BoolArray, IntArray
from offline.alignment import fit_transform
from offline.global_map import solve_global_map
from offline.graph import Graph
from offline.local_map import LocalMap, solve_local_map
from offline.merge import merge
from offline.result import SuspectTag
from offline.solver import Solution
from offline.stages import Stages
from offline.suspects import Searched, split_alone, split_together, with_outliers_apart
from offline.suspects_report import suspect_tags
from offline.suspects_search import gain_of, settled
from tests.made_moves import CLEAN, DUPLICATED, MOVED, MOVING, SWAPPED, Scene, made_scene, without

KINDS: Final = (CLEAN, MOVED, MOVING, SWAPPED, DUPLICATED)
SHIFTS_M: Final = (0.1, 0.3, 1.0)
MOST_TAGS: Final = 5
CLEAR_SIGMAS: Final = 6.0
NAMED_SHARE: Final = 0.95
FALSE_A_MAP: Final = 0.1
FALSE_CLEAN: Final = 0.05
MAP_FACTOR: Final = 1.1
SIGMA_BINS: Final = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 25.0, 50.0, np.inf)


@dataclass(frozen=True)
class Told:
    """One tag that something was done to.

    Attributes:
        sigmas: by the shift and its foretold covariance; 0 where not seen on both sides.
        named: as a suspect; right: as of the right kind.
    """

    sigmas: float
    named: bool
    right: bool


@dataclass
class Counts:
    """Of all trials of a kind."""

    told: list[Told] = field(default_factory=list)
    n_maps: int = 0
    n_false: int = 0
    n_apart: int = 0  # maps in several components
    squares_m2: list[float] = field(default_factory=list)  # of the rest of the map
    squares_without_m2: list[float] = field(default_factory=list)

    @property
    def clear(self) -> list[Told]:
        """Those whose shift is beyond the bound."""
        return [each for each in self.told if each.sigmas > CLEAR_SIGMAS]

    @property
    def right_share(self) -> float:
        """Of the clear ones."""
        return float(np.mean([each.right for each in self.clear])) if self.clear else 1.0

    @property
    def map_factor(self) -> float:
        """Error of the rest of the map over that without the tags in question."""
        if not self.squares_without_m2:
            return 1.0
        return float(np.sqrt(np.sum(self.squares_m2) / np.sum(self.squares_without_m2)))


def mapped(maps: Sequence[LocalMap]) -> Searched | None:
    """The map and what was found in it; None where the runs do not hang together."""
    alone = [split_alone(each) for each in maps]
    merged = merge(alone)
    if len(merged.groups) > 1:
        return None
    apart = with_outliers_apart(alone, merged)
    return split_together(*solve_global_map(apart, merged.groups[0], Stages()), apart)


def trial(scene: Scene, counts: Counts, *, compare: bool) -> list[SuspectTag]:
    """Maps a scene and adds what came of it; `compare`: also with the map without the tags in question."""
    counts.n_maps += 1
    searched = mapped([solve_local_map(drive.chain) for drive in scene.drives])
    if searched is None:
        counts.n_apart += 1
        counts.told += [Told(0.0, named=False, right=False) for _ in scene.ids]
        return []
    suspects = suspect_tags(searched)
    named = {each.tag_id: each for each in suspects}
    partner = dict(zip(scene.ids, np.roll(scene.ids, len(scene.ids) // 2).tolist(), strict=True))
    sigmas = foretold_sigmas(scene, searched)
    for tag_id in scene.ids:
        found = named.get(tag_id)
        right = found is not None and found.kind == scene.kind
        right &= found is None or found.kind != SWAPPED or found.swapped_with == partner[tag_id]
        counts.told.append(Told(sigmas[tag_id], found is not None, right))
    counts.n_false += len(named.keys() - set(scene.ids))
    if compare and scene.ids:
        chains = [without(drive.chain, scene.ids) for drive in scene.drives]
        alone = [solve_local_map(chain) for chain in chains]
        merged = merge(alone)
        if len(merged.groups) == 1:
            counts.squares_m2.append(map_error_m2(scene, searched.graph, searched.solution))
            counts.squares_without_m2.append(map_error_m2(scene, *solve_global_map(alone, merged.groups[0], Stages())))
    return suspects


def foretold_sigmas(scene: Scene, searched: Searched) -> dict[int, float]:
    """The shift of each tag in question by the covariance of splitting it as it truly was, the others being split.

    0 where the readings are not of both places; for doubles unless the one seen first was seen again after the other,
    for moving tags unless one run saw both: else nobody can tell them from tags that were moved between runs.
    """
    sightings, evidence = searched.sightings, searched.evidence
    truly_other = _truly_other(scene, searched)[evidence.which]
    own_id = np.array([sightings.ids[i].tag_id for i in sightings.id[evidence.which]])
    place = sightings.id[evidence.which]
    place = np.where(truly_other, place + len(sightings.ids), place)
    found: dict[int, float] = {}
    for tag_id in scene.ids:
        members = np.flatnonzero((own_id == tag_id) & truly_other)
        of_tag = np.flatnonzero(own_id == tag_id)
        found[tag_id] = 0.0
        if not _can_be_told(scene, searched, of_tag, members):
            continue
        joined = place.copy()
        joined[members] = place[of_tag[~np.isin(of_tag, members)][0]]
        _, information = gain_of(settled(evidence, joined), members)
        shift_m = scene.other_m[tag_id] - scene.first_m[tag_id]
        # The frame of the map is turned against the town's; the weakest direction is what is asked for.
        found[tag_id] = float(np.linalg.norm(shift_m) * np.sqrt(np.linalg.eigvalsh(information)[0]))
    return found


def _truly_other(scene: Scene, searched: Searched) -> BoolArray:
    """(S,) which sightings are of the other place of their tag."""
    other: list[BoolArray] = []
    for run, chain in enumerate(searched.graph.chains):
        mask = np.zeros(len(chain.readings), dtype=np.bool_)
        ids = np.array([tag.tag_id for tag in chain.tags], dtype=np.int64)[chain.readings.tag]
        for tag_id in set(scene.ids) & set(ids.tolist()):
            mask[ids == tag_id] = scene.is_other(run, tag_id)
        other.append(mask)
    share = np.bincount(searched.sightings.of_reading, np.concatenate(other)) / searched.sightings.n_readings
    return np.asarray(share > 0.5)


def _can_be_told(scene: Scene, searched: Searched, of_tag: IntArray, members: IntArray) -> bool:
    """Whether sightings of a tag, some of its other place, show what was done to it."""
    if not 0 < len(members) < len(of_tag):
        return False
    chain = searched.sightings.chain[searched.evidence.which]
    if scene.kind == MOVING:
        return bool(set(chain[members]) & set(chain[np.setdiff1d(of_tag, members)]))
    return scene.kind != DUPLICATED or _came_back(searched, of_tag, members)


def _came_back(searched: Searched, of_tag: IntArray, members: IntArray) -> bool:
    """Whether a tag was seen at one place, at the other, and at the first again."""
    which = searched.evidence.which
    rank = {s: i for i, s in enumerate(searched.sightings.in_time.tolist())}
    ordered = np.array(sorted(of_tag.tolist(), key=lambda k: rank[int(which[k])]))
    return searched.sightings.came_back(which[ordered], np.isin(ordered, members))


def map_error_m2(scene: Scene, graph: Graph, solution: Solution) -> float:
    """Mean squared error of the tags that nothing was done to, laid over the truth."""
    tags = [tag for tag in graph.tags if tag.tag_id not in scene.ids and tag.instance in ("", "a")]
    places = graph.tags_of(solution.state)
    found = np.array([places[tag] for tag in tags])
    true = np.array([scene.first_m[tag.tag_id] for tag in tags])
    left = se2.apply(fit_transform(true, found), found) - true
    return float((left**2).sum(axis=1).mean())


def scenes(kind: str, shift_m: float, n_trials: int, seed: int) -> Iterator[Scene]:
    """One to five tags each, in turn."""
    for i in range(n_trials):
        yield made_scene(seed + i, kind, 0 if kind == CLEAN else 1 + i % MOST_TAGS, shift_m)


def study(kinds: Sequence[str], n_trials: int, seed: int, compare_every: int) -> dict[tuple[str, float], Counts]:
    """All trials; a row for each kind and shift as it is done."""
    table: dict[tuple[str, float], Counts] = {}
    for kind in kinds:
        for shift_m in SHIFTS_M if kind in (MOVED, MOVING) else (0.0,):
            first = seed + 100_000 * KINDS.index(kind) + round(10_000 * shift_m)
            counts = table.setdefault((kind, shift_m), Counts())
            began_s = time.process_time()
            for i, scene in enumerate(scenes(kind, shift_m, n_trials, first)):
                trial(scene, counts, compare=i % compare_every == 0)
            _tell(f"{row(kind, shift_m, counts)}; {time.process_time() - began_s:.0f} s")
    return table


def row(kind: str, shift_m: float, counts: Counts) -> str:
    """In words."""
    what = f"{kind} by {shift_m:g} m" if shift_m else kind
    return (
        f"{what}: {counts.n_maps} maps, {len(counts.told)} tags, of {len(counts.clear)} beyond {CLEAR_SIGMAS:g} sigma "
        f"{counts.right_share:.1%} named right ({np.mean([each.named for each in counts.clear] or [True]):.1%} named); "
        f"{counts.n_false / max(counts.n_maps, 1):.3f} false names a map; {counts.n_apart} in parts; rest of the map "
        f"{counts.map_factor:.3f} times the error without"
    )


def detection_curve(told: Sequence[Told]) -> list[tuple[float, float, int, float, float]]:
    """Least and most sigmas, how many tags, share named, share named right."""
    rows = []
    for low, high in pairwise(SIGMA_BINS):
        own = [each for each in told if low < each.sigmas <= high]
        if own:
            named, right = np.mean([each.named for each in own]), np.mean([each.right for each in own])
            rows.append((low, high, len(own), float(named), float(right)))
    return rows


def missed_bounds(table: dict[tuple[str, float], Counts]) -> list[str]:
    """A sentence for each."""
    missed = []
    for (kind, shift_m), counts in table.items():
        what = f"{kind} by {shift_m:g} m" if shift_m else kind
        if counts.right_share < NAMED_SHARE:
            missed.append(f"{what}: {counts.right_share:.1%} named right, at least {NAMED_SHARE:.0%} asked")
        most = FALSE_CLEAN if kind == CLEAN else FALSE_A_MAP
        if counts.n_false >= most * counts.n_maps and counts.n_false:
            missed.append(
                f"{what}: {counts.n_false} false names in {counts.n_maps} maps, fewer than {most:g} each asked"
            )
        if counts.map_factor > MAP_FACTOR:
            missed.append(
                f"{what}: the rest of the map is {counts.map_factor:.3f} times as far off, {MAP_FACTOR} asked"
            )
    return missed


def draw_curve(table: dict[tuple[str, float], Counts], path: Path) -> None:
    """Share of tags named over how many foretold sigmas they were moved."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for kind in (MOVED, MOVING, SWAPPED, DUPLICATED):
        rows = detection_curve([each for (own, _), counts in table.items() if own == kind for each in counts.told])
        # A bin of a tag or two says nothing.
        rows = [each for each in rows if each[2] >= 10]
        at = [np.sqrt(max(low, 0.5) * min(high, 100.0)) for low, high, *_ in rows]
        if rows:
            axes.plot(at, [100.0 * each[4] for each in rows], "o-", ms=4, label=kind)
    axes.axvline(CLEAR_SIGMAS, color="0.6", lw=1)
    axes.axhline(100.0 * NAMED_SHARE, color="0.6", lw=1)
    axes.set(xscale="log", xlabel="shift, in sigmas foretold for the split", ylabel="named with the right kind, %")
    axes.set(ylim=(-3.0, 103.0))
    axes.set_xticks([1, 2, 3, 6, 10, 30, 100], ["1", "2", "3", "6", "10", "30", "100"])
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200, help="of each kind and shift [200]")
    parser.add_argument("--kinds", default=",".join(KINDS), help="[all]")
    parser.add_argument("--seed", type=int, default=1, help="the first; one more each trial [1]")
    parser.add_argument("--compare-every", type=int, default=1, help="the map without the tags each so many trials [1]")
    parser.add_argument("--output", type=Path, default=Path("build/benchmarks"), help="of the curve's picture")
    given = parser.parse_args(arguments)
    table = study(given.kinds.split(","), given.trials, given.seed, given.compare_every)
    told = [each for counts in table.values() for each in counts.told]
    for low, high, n, named, right in detection_curve(told):
        _tell(f"{low:5.0f} to {high:3.0f} sigma: {n:5d} tags, {named:6.1%} named, {right:6.1%} right")
    given.output.mkdir(parents=True, exist_ok=True)
    draw_curve(table, given.output / "suspects_detection.png")
    missed = missed_bounds(table)
    for sentence in missed:
        _tell(f"missed: {sentence}")
    return 1 if missed else 0


def _tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
