"""How the turn of a map bends what is known of its tags: what a step of Gauss-Newton leaves out, and needs not.

A turn of everything about the robot changes no reading and no motion. It carries the map's tags along arcs; what is
known of them is in straight lines. Where wheels and map pull at each other, that weighs as much as what is known of the
map's turn, and steps that leave it out close in on the solution by as little as three per cent each.
"""

from typing import Final

import numpy as np

from calib.arrays import FloatArray
from offline.online_answers import move
from offline.online_root import OnlineRoot

# How much of the bend is counted: the most that leaves this much of the curvature, so that no step runs away.
_SHARES: Final = tuple(np.linspace(1.0, 0.1, 10).tolist())
_LEAST_CURVATURE: Final = 0.1


def bent_step(root: OnlineRoot) -> FloatArray:
    """(3 + n,) as `OnlineRoot.step`, but for the bend.

    With phi the pose's turn, p its place, x the tags, f what pulls at them and J a quarter turn, the cost has the term
    f (phi^2 (x - p) / 2 + phi J (dx - dp)) besides. It is of rank two: Woodbury's formula.
    """
    step, prior = root.step, root.prior
    pull = (prior.root.T @ (prior.root @ (step[3:] - prior.off)))[prior.first_tag :].reshape(-1, 2)
    pose = root.pose
    turned = np.column_stack([pull[:, 1], -pull[:, 0]])
    ways = np.zeros((2, len(step)))
    ways[0, 2] = 1.0
    ways[1, 3 + prior.first_tag :] = turned.reshape(-1)
    ways[1, :2] = -turned.sum(axis=0) @ _turn(pose[2])
    bend = np.array([[float((pull * (root.places_m - pose[:2])).sum()), 1.0], [1.0, 0.0]])
    taken = root.carried(ways)
    added = bend @ (taken @ taken.T)
    share = next((s for s in _SHARES if np.linalg.det(np.eye(2) + s * added) > _LEAST_CURVATURE), 0.0)
    inner = np.linalg.solve(np.eye(2) + share * added, share * bend @ (ways @ step))
    return np.asarray(step - root.through(inner @ taken))


def carried_along(root: OnlineRoot, step: FloatArray) -> FloatArray:
    """(T, 2) the tags after a step, in which they turn with the pose."""
    before, after = root.point, np.empty(3)
    move(before, step[:3], after)
    off = root.prior.places_m - before[:2]
    moved = step[3 + root.prior.first_tag :].reshape(-1, 2) - _turn(before[2]) @ step[:2]
    own = off + moved - step[2] * np.column_stack([-off[:, 1], off[:, 0]])
    return np.asarray(after[:2] + own @ _turn(step[2]).T)


def _turn(angle_rad: float) -> FloatArray:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])
