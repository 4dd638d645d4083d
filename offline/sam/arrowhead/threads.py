"""Chains eliminated on several cores: they meet in the top only."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.sam.arrowhead.elimination import eliminate
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.linearisation.blocks import Rows, System


def eliminate_chains(tree: Tree, system: System, damping: float, rows: Rows, threads: int) -> int:
    """Eliminates all but the top, whose front is left in the workspace of `rows`.

    Returns:
        -1, or a column whose pivot is not positive.
    """
    rows.workspace[:] = 0.0
    top = len(tree.level) - 1
    bounds = _shared_out(tree, threads)
    if len(bounds) <= 2:
        return eliminate(tree, system, damping, rows, 0, top + 1)
    rooms = [rows, *(_own_room(rows) for _ in bounds[2:])]
    with ThreadPoolExecutor(len(rooms)) as pool:
        parts = [
            pool.submit(eliminate, tree, system, damping, room, int(begin), int(end))
            for room, begin, end in zip(rooms, bounds[:-1], bounds[1:], strict=True)
        ]
        failed = [part.result() for part in parts]
    if max(failed) >= 0:
        return max(failed)
    front = slice(int(tree.workspace_start[-2]), None)
    for room in rooms[1:]:
        rows.workspace[front] += room.workspace[front]
    return eliminate(tree, system, damping, rows, top, top + 1)


def _shared_out(tree: Tree, threads: int) -> IntArray:
    """Bounds of groups of nodes, whole chains each and about as many nodes; at most `threads` groups."""
    n = len(tree.level) - 1
    chain_ends = np.flatnonzero(np.diff(tree.chain[:n])) + 1
    wanted = np.arange(1, threads) * n / threads
    nearest = [int(chain_ends[np.argmin(np.abs(chain_ends - each))]) for each in wanted] if len(chain_ends) else []
    return np.unique([0, *nearest, n])


def _own_room(rows: Rows) -> Rows:
    """Room for another thread: rows of chains lie apart, fronts and scratch do not."""
    return rows._replace(
        workspace=np.zeros_like(rows.workspace),
        border=np.empty_like(rows.border),
        blocks=np.empty_like(rows.blocks),
        inside=np.empty_like(rows.inside),
    )
