"""One chain solved alone, in the frame of its start."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib import se2
from calib.arrays import FloatArray
from offline.chain import Chain
from offline.graph import Graph, Parameter, build_graph
from offline.odometry import chained
from offline.run import TagKey
from offline.solver import COST_TOLERANCE, Solution, solve

# A chain is built up in pieces over which dead reckoning stays in the right basin: what a wheel ratio 1 % off turns in
# this distance (0.2 rad on a half-metre track) is far from losing a tag.
_PIECE_M: Final = 10.0
# In squared sigmas: a piece is only the next one's start.
_PIECE_COST_TOLERANCE: Final = 1e-2


@dataclass(frozen=True)
class LocalMap:
    """A chain in the frame of its start."""

    chain: Chain
    graph: Graph
    solution: Solution

    @property
    def T_start_base(self) -> FloatArray:
        """(K, 3) of the keyframes."""
        return self.solution.state.poses

    @property
    def tags_m(self) -> dict[TagKey, FloatArray]:
        """Each tag (2,) in the frame of the start."""
        return self.graph.tags_of(self.solution.state)

    @property
    def calibration(self) -> dict[Parameter, float]:
        """What the chain says of the calibration."""
        return self.graph.calibration_of(self.solution.state)


def solve_local_map(chain: Chain) -> LocalMap:
    """Builds the chain up piece by piece, each from the solution of the last; the last piece is the whole."""
    poses = np.zeros((1, 3))
    wheel_calibration = np.zeros(3)
    tags: dict[TagKey, FloatArray] = {}
    calibration: dict[Parameter, float] = {}
    local_map: LocalMap | None = None
    for n_keyframes in _pieces(chain):
        part = chain.prefix(n_keyframes)
        graph = build_graph([part])
        start = graph.start(_extended(part, poses, wheel_calibration), tags, calibration)
        whole = n_keyframes == len(chain.stamps_ns)
        solution = solve(graph.problem, start, COST_TOLERANCE if whole else _PIECE_COST_TOLERANCE)
        poses, wheel_calibration = solution.state.poses, graph.wheel_calibration(solution.state, 0)
        tags, calibration = graph.tags_of(solution.state), graph.calibration_of(solution.state)
        local_map = LocalMap(chain, graph, solution)
    if local_map is None:
        raise ValueError(f"{chain.name}: a chain has one keyframe at least")
    return local_map


def _pieces(chain: Chain) -> list[int]:
    """Numbers of keyframes at which to stop and solve; the last is all of them."""
    distance_m = np.concatenate([[0.0], np.cumsum(chain.odometry.distance_m)])
    piece = (distance_m / _PIECE_M).astype(np.int64)
    cuts = np.flatnonzero(np.diff(piece)) + 1
    return [*(int(cut) for cut in cuts if cut < len(distance_m)), len(distance_m)]


def _extended(part: Chain, poses: FloatArray, wheel_calibration: FloatArray) -> FloatArray:
    """Poses of a longer chain: those known, then dead reckoning from the last one."""
    n_known = len(poses)
    rest = part.odometry.motion[n_known - 1 :]
    if not len(rest):
        return poses
    rest = se2.compose(rest, se2.exp(part.odometry.jacobian[n_known - 1 :] @ wheel_calibration))
    return np.concatenate([poses, chained(rest, poses[-1])[1:]])
