"""Many local maps -> components, each with one frame: which chains the shared tags join, and where each starts."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib import se2
from calib.arrays import FloatArray
from offline.alignment import Alignment, align
from offline.local_map import LocalMap


@dataclass(frozen=True)
class PairAlignment:
    """Two local maps, by index, and how the second lies in the first; None where they share too little."""

    a: int
    b: int
    n_shared: int
    alignment: Alignment | None


@dataclass(frozen=True)
class Group:
    """Chains that alignments join.

    Attributes:
        members: indices of local maps in the order given; the first one's start is the frame.
        T_frame_start: (n, 3) starting values of the members' starts.
    """

    members: tuple[int, ...]
    T_frame_start: FloatArray


def align_pairs(maps: Sequence[LocalMap]) -> list[PairAlignment]:
    """Every pair of local maps that shares a tag."""
    pairs = []
    for a, b in combinations(range(len(maps)), 2):
        tags_a, tags_b = maps[a].tags_m, maps[b].tags_m
        n_shared = len(tags_a.keys() & tags_b.keys())
        if n_shared:
            pairs.append(PairAlignment(a, b, n_shared, align(tags_a, tags_b)))
    return pairs


def group(maps: Sequence[LocalMap], pairs: Sequence[PairAlignment]) -> list[Group]:
    """Components of the maps under the alignments found, largest first (most tags, then most keyframes).

    Starts follow from the strongest alignments (a spanning tree by number of inliers, then by their spread), so that
    they do not depend on the order of the logs.
    """
    tree = _spanning_tree(len(maps), pairs)
    left = set(range(len(maps)))
    groups = []
    while left:
        frame = min(left)
        placed = {frame: np.zeros(3)}
        queue = [frame]
        while queue:
            here = queue.pop(0)
            for there, T_here_there in tree[here]:
                if there not in placed:
                    placed[there] = se2.compose(placed[here], T_here_there)
                    queue.append(there)
        members = tuple(sorted(placed))
        left -= placed.keys()
        groups.append(Group(members, np.array([placed[m] for m in members])))

    def size(candidate: Group) -> tuple[int, int, int]:
        tags = {tag for m in candidate.members for tag in maps[m].graph.tags}
        return -len(tags), -sum(len(maps[m].T_start_base) for m in candidate.members), candidate.members[0]

    return sorted(groups, key=size)


def reason_apart(
    name: str, others: Sequence[int], index: int, maps: Sequence[LocalMap], pairs: Sequence[PairAlignment]
) -> str:
    """Why a local map is joined to none of the others, and what would help."""
    if not maps[index].graph.tags:
        return f"{name} saw no tag, so nothing ties it to the other runs; it is kept as a trajectory of its own"
    best: PairAlignment | None = None
    for pair in pairs:
        if (
            index in (pair.a, pair.b)
            and (pair.a in others or pair.b in others)
            and (best is None or pair.n_shared > best.n_shared)
        ):
            best = pair
    if best is None:
        return f"{name} shares no tag with the others; drive it past two tags that another run saw"
    partner = maps[best.b if best.a == index else best.a].chain.name
    if best.n_shared == 1:
        return f"{name} shares only one tag with {partner}; one more shared tag would do"
    return (
        f"{name} shares {best.n_shared} tags with {partner}, but no two of them lie the same way in both maps "
        "(within 0.5 m): were tags moved between the runs?"
    )


def _spanning_tree(n: int, pairs: Sequence[PairAlignment]) -> list[list[tuple[int, FloatArray]]]:
    """Kruskal's: neighbours of each map with T_here_there, strongest alignments first."""
    root = list(range(n))

    def find(i: int) -> int:
        while root[i] != i:
            i = root[i]
        return i

    tree: list[list[tuple[int, FloatArray]]] = [[] for _ in range(n)]
    found = [(pair, pair.alignment) for pair in pairs if pair.alignment is not None]
    for pair, alignment in sorted(found, key=lambda f: (-f[1].n_inliers, f[1].rmse_m)):
        root_a, root_b = find(pair.a), find(pair.b)
        if root_a != root_b:
            root[root_a] = root_b
            tree[pair.a].append((pair.b, alignment.T_a_b))
            tree[pair.b].append((pair.a, se2.inverse(alignment.T_a_b)))
    return tree
