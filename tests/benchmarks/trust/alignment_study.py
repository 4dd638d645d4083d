"""How often two local maps are aligned right, not at all, or wrong, where some of the tags they share are wrong.

    python -m tests.benchmarks.trust.alignment_study [--trials 2000] [--groups 400] [--drives 12] [--seed 1]

Robots drive 800 m at random through a town, each alone, and are bent by up to twenty degrees. Some drive where half of
the tags have been moved by a metre or more, each on its own: one in two to somewhere else in town, the others by less
than three metres. Others drive where half of the tags in each part of the town have been moved as one, like a shelf. A
trial takes a map of the town as it was, a map of the town as it became, and 6 to 20 neighbouring tags that both saw,
among them as many wrong ones as asked for, four being true at least. What is claimed must be right; exit 1 where a
bound is missed.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.condensed_map import CondensedMap, condense
from groundsbot.offline.alignment.model_selection import GROUP_MARGIN
from groundsbot.offline.alignment.pairwise import Alignment, align
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.measurements.tags import TagKey
from tests.benchmarks.command_line import say
from tests.support.data.long_drives import Town, make_long_drive, make_town

N_SHARED: Final = (6, 20)
N_TRUE: Final = 4
LEAST_SHIFT_M: Final = 1.0
SHELF_SHIFT_M: Final = (2.0, 8.0)
PART_M: Final = 50.0  # of the town
TAG_SPACING_M: Final = (2.0, 8.0)
LENGTH_M: Final = 800.0
RIGHT: Final = "right"
WRONG: Final = "WRONG"
UNSURE: Final = "not sure"
AMBIGUOUS: Final = "ambiguous"
# Shares of wrong tags, and in how many trials the alignment must be right.
BOUNDS: Final = {(0.0, 0.5): 0.99, (0.5, 0.7): 0.90}
GROUPS: Final = ((0.35, 0.65), (0.1, 0.33))
# An alignment is right within its covariance: of 2,000 right ones none is beyond this but for one time in 50.
_GATE: Final = float(chi2.isf(1e-5, 3))


@dataclass(frozen=True)
class SolvedDrive:
    """A local map, and what is true of it.

    Attributes:
        T_town_frame: (3,) of the frame that the map's root carries.
        T_town_moved: (T, 3) how each tag of the town was moved before the drive, if it was.
        moved: (T,) which were.
    """

    condensed: CondensedMap
    T_town_frame: FloatArray
    T_town_moved: FloatArray
    moved: BoolArray


@dataclass(frozen=True)
class Trial:
    """Two maps of which the second has some tags elsewhere.

    Attributes:
        wrong: (n,) which of the shared tags.
        T_a_b: (3,) the truth.
        T_a_b_moved: (3,) what the first of the wrong tags says.
    """

    a: CondensedMap
    b: CondensedMap
    wrong: BoolArray
    T_a_b: FloatArray
    T_a_b_moved: FloatArray

    @cached_property
    def alignment(self) -> Alignment | None:
        """What is made of it."""
        return align(self.a, self.b)

    def outcome(self) -> str:
        """The outcome as a word."""
        if self.alignment is None:
            return UNSURE
        if self.alignment.is_accepted:
            return RIGHT if self.agrees(self.alignment, self.T_a_b) else WRONG
        return AMBIGUOUS if self.alignment.alternatives else UNSURE

    def group_outcome(self) -> str:
        """The outcome as text, where the wrong tags moved as one."""
        n_wrong, n = int(self.wrong.sum()), len(self.wrong)
        outcome = self.outcome()
        if outcome == AMBIGUOUS and not self.lists_both():
            outcome = "one rival missing"
        alike = max(n_wrong, n - n_wrong) < GROUP_MARGIN * min(n_wrong, n - n_wrong)
        return outcome if outcome == WRONG else f"{outcome} ({'similar' if alike else 'unlike'} numbers)"

    def agrees(self, alignment: Alignment, T_a_b: FloatArray) -> bool:
        """Whether an alignment is a transform within its covariance, or by less than a wrong tag is off."""
        error = se2.log(se2.between(T_a_b, alignment.T_a_b))
        if float(error @ np.linalg.solve(alignment.covariance, error)) < _GATE:
            return True
        index = {tag: i for i, tag in enumerate(self.b.tags)}
        places = self.b.tags_m[[index[tag] for tag in alignment.inliers]]
        off_m = se2.apply(alignment.T_a_b, places) - se2.apply(T_a_b, places)
        return float(np.sqrt((off_m**2).sum(axis=1).mean())) < LEAST_SHIFT_M

    def lists_both(self) -> bool:
        """Whether the truth and the hypothesis of the moved tags are among the alternatives."""
        if self.alignment is None:
            return False
        told = (self.alignment, *self.alignment.alternatives)
        return all(any(self.agrees(each, T) for each in told) for T in (self.T_a_b, self.T_a_b_moved))


def solved_drive(
    seed: int, town: Town, T_moved: FloatArray, moved: BoolArray, length_m: float = LENGTH_M
) -> SolvedDrive:
    """Drives through the town after some of its tags were moved, and solves that alone."""
    places = np.where(moved[:, None], se2.apply(T_moved, town.tags_m), town.tags_m)
    noise = NoiseParameters()
    drive = make_long_drive(seed, length_m, town=replace(town, tags_m=places), noise=noise, noise_factors=(1.0, 1.0))
    local_map = solve_local_map(drive.segment)
    condensed = condense(local_map, local_map.graph.tags)
    root = condensed.T_start_anchor[condensed.root]
    T_town_root = se2.compose(drive.T_town_start, drive.T_start_base[local_map.graph.problem.anchor[condensed.root]])
    return SolvedDrive(condensed, se2.compose(T_town_root, se2.inverse(root)), T_moved, moved)


class Pool:
    """Drives through one town: as it was, with tags moved each on its own, and with tags moved as one."""

    def __init__(self, n_each: int, seed: int, length_m: float = LENGTH_M) -> None:
        rng = np.random.default_rng(seed)
        town = make_town(seed, TAG_SPACING_M)
        n = len(town.tags_m)
        still = np.zeros((n, 3)), np.zeros(n, dtype=np.bool_)
        seeds = iter(range(1000 * seed, 1000 * seed + 3 * n_each))
        self.before = [solved_drive(next(seeds), town, *still, length_m) for _ in range(n_each)]
        self.each = [solved_drive(next(seeds), town, *_each_moved(town, rng), length_m) for _ in range(n_each)]
        self.shelf = [solved_drive(next(seeds), town, *_shelves_moved(town, rng), length_m) for _ in range(n_each)]


def trial(
    pool: Sequence[SolvedDrive],
    others: Sequence[SolvedDrive],
    rng: np.random.Generator,
    share: tuple[float, float],
    *,
    as_one: bool = False,
) -> Trial:
    """One of each, and neighbouring tags that both have, with a share of wrong ones between these two.

    Args:
        pool: of the town as it was.
        others: of the town as it became.
        rng: chooses.
        share: least and most of the tags.
        as_one: the wrong ones moved together.
    """
    while True:
        a, b = pool[int(rng.integers(len(pool)))], others[int(rng.integers(len(others)))]
        n = int(rng.integers(N_SHARED[0], N_SHARED[1] + 1))
        most = min(int(share[1] * n), n - N_TRUE)
        n_wrong = int(rng.integers(min(int(np.ceil(share[0] * n)), most), most + 1))
        shared = np.array(sorted({tag.tag_id for tag in a.condensed.tags} & {tag.tag_id for tag in b.condensed.tags}))
        index = {tag.tag_id: i for i, tag in enumerate(a.condensed.tags)}
        places = a.condensed.tags_m[[index[i] for i in shared]]
        wrong_first = rng.permutation(shared[b.moved[shared]])[:1]
        centre = places[np.isin(shared, wrong_first)] if len(wrong_first) else places[:1]
        near = shared[np.argsort(np.linalg.norm(places - centre[:1], axis=1))]
        if as_one and len(wrong_first):
            near = near[~b.moved[near] | (b.T_town_moved[near] == b.T_town_moved[wrong_first[0]]).all(axis=1)]
        wrong, true = near[b.moved[near]][:n_wrong], near[~b.moved[near]][: n - n_wrong]
        if len(wrong) == n_wrong and len(true) == n - n_wrong:
            break
    chosen = np.sort(np.concatenate([wrong, true]))
    T_a_b = se2.between(a.T_town_frame, b.T_town_frame)
    # Where the town lies in frame b as a moved tag has it.
    T_moved = b.T_town_moved[wrong[0]] if n_wrong else np.zeros(3)
    moved = se2.compose(se2.compose(se2.inverse(a.T_town_frame), se2.inverse(T_moved)), b.T_town_frame)
    return Trial(restrict(a.condensed, chosen), restrict(b.condensed, chosen), b.moved[chosen], T_a_b, moved)


def _each_moved(town: Town, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
    """Half of the tags, each on its own."""
    n = len(town.tags_m)
    length_m, angle = rng.uniform(LEAST_SHIFT_M, 3.0 * LEAST_SHIFT_M, n), rng.uniform(-np.pi, np.pi, n)
    near = np.stack([length_m * np.cos(angle), length_m * np.sin(angle)], axis=-1)
    far = town.tags_m[rng.permutation(n)] - town.tags_m + rng.uniform(-1.0, 1.0, (n, 2))
    far[np.linalg.norm(far, axis=1) < LEAST_SHIFT_M] = [0.0, LEAST_SHIFT_M]
    shift = np.where(rng.random(n)[:, None] < 0.5, near, far)
    return np.column_stack([shift, np.zeros(n)]), rng.random(n) < 0.5


def _shelves_moved(town: Town, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
    """In each part of the town the tags on one side of a line, as one."""
    n = len(town.tags_m)
    part = (town.tags_m // PART_M).astype(np.int64) @ np.array([1, 1000])
    T, moved = np.zeros((n, 3)), np.zeros(n, dtype=np.bool_)
    for each in np.unique(part):
        here = part == each
        middle = town.tags_m[here].mean(axis=0)
        angle, shift_m = rng.uniform(-np.pi, np.pi, 2), rng.uniform(*SHELF_SHIFT_M)
        moved |= here & ((town.tags_m - middle) @ np.array([np.cos(angle[0]), np.sin(angle[0])]) > 0.0)
        turn = np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)])
        there = middle + shift_m * np.array([np.cos(angle[1]), np.sin(angle[1])]) - se2.apply(turn, middle)
        T[here] = [*there, turn[2]]
    return T, moved


def restrict(condensed: CondensedMap, tag_ids: IntArray) -> CondensedMap:
    """With some of its tags only, and its root."""
    which = keep = np.flatnonzero(np.isin([tag.tag_id for tag in condensed.tags], tag_ids))
    root = condensed.root
    # The root's anchor need not be one of a tag that is kept; it comes along with a tag that is not shared.
    if root not in keep:
        keep = np.append(keep, root)
    n = len(condensed.tags)
    columns = np.concatenate([(3 * keep[:, None] + np.arange(3)).ravel(), (3 * n + 2 * keep[:, None] + [0, 1]).ravel()])
    tags = [condensed.tags[i] for i in keep]
    if root not in which:
        tags[-1] = TagKey(f"only in {condensed.name}", 0)
    return replace(
        condensed,
        tags=tuple(tags),
        T_start_anchor=condensed.T_start_anchor[keep],
        tag_m=condensed.tag_m[keep],
        covariance=condensed.covariance[np.ix_(columns, columns)],
        root=int(np.flatnonzero(keep == root)[0]),
    )


def study(n_trials: int, n_groups: int, n_drives: int, seed: int) -> int:
    """Prints the counts; 1 where a bound is missed."""
    began_s = time.perf_counter()
    pool = Pool(n_drives, seed)
    say(f"{3 * n_drives} drives solved in {time.perf_counter() - began_s:.0f} s")
    rng = np.random.default_rng(seed)
    missed = False
    for share, bound in BOUNDS.items():
        began_s = time.perf_counter()
        counts = Counter(trial(pool.before, pool.each, rng, share).outcome() for _ in range(n_trials // len(BOUNDS)))
        say(_row(f"{share[0]:.0%} to {share[1]:.0%} wrong, each on its own", counts, began_s))
        missed |= counts[WRONG] > 0 or counts[RIGHT] < bound * counts.total()
    for share in GROUPS:
        began_s = time.perf_counter()
        counts = Counter(
            trial(pool.before, pool.shelf, rng, share, as_one=True).group_outcome() for _ in range(n_groups // 2)
        )
        say(_row(f"{share[0]:.0%} to {share[1]:.0%} moved as one", counts, began_s))
        missed |= counts[WRONG] > 0
    return int(missed)


def _row(what: str, counts: Counter[str], began_s: float) -> str:
    told = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
    return f"{what}: {counts.total()} trials: {told}; {time.perf_counter() - began_s:.0f} s"


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=2000, help="with tags that are wrong each on its own [2000]")
    parser.add_argument("--groups", type=int, default=400, help="with tags that moved as one [400]")
    parser.add_argument("--drives", type=int, default=12, help="of each kind [12]")
    parser.add_argument("--seed", type=int, default=1, help="of everything [1]")
    given = parser.parse_args(arguments)
    return study(given.trials, given.groups, given.drives, given.seed)


if __name__ == "__main__":
    sys.exit(main())
