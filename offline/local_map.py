"""One chain solved alone, in the frame of its start.

A long drive past few tags has many valleys. It is built up piece by piece on a few of its keyframes; where the solve
from there does not fit together, the drive is built up again with other draws of the wheels' noise, until one fits.

Readings that contradict each other everywhere make each of these solves take hundreds of steps, where those of a drive
take four. So that a small file of them does not take minutes, the search has an effort to spend, which grows with the
log: a drive's log has some hundred bytes a keyframe.
"""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from calib import se2
from calib.arrays import FloatArray
from offline.chain import Chain
from offline.coarse_chain import coarse_keyframes, coarsened, refined
from offline.errors import OfflineError
from offline.goodness import Goodness, fitted_windows
from offline.graph import Graph, Parameter, build_graph
from offline.odometry import chained
from offline.run import TagKey
from offline.solver import Solution, solve

# A chain is built up in pieces over which dead reckoning stays in the right valley: what a wheel ratio 1 % off turns in
# this distance (0.2 rad on a half-metre track) is far from losing a tag. Later, when the wheels are known, they grow
# with the way, so that the time does not grow with its square.
_PIECE_M: Final = 10.0
_PIECE_SHARE: Final = 0.01
# In squared sigmas: a piece is only the next one's start.
_PIECE_COST_TOLERANCE: Final = 1e-2
_OTHER_STARTS: Final = 8
# Effort: factors linearised. A drive of 10,000 keyframes takes 0.4 million a start, and its log has 4 MB; one of 2 km
# past few tags takes 0.5 million.
_FREE_EFFORT: Final = 1_000_000
_EFFORT_PER_BYTE: Final = 1.0
# Linearisations a piece, on average: three to five on any drive, hundreds where no reading agrees with the next.
_MOST_STEPS: Final = 50


@dataclass(frozen=True)
class LocalMap:
    """A chain in the frame of its start, and whether its readings fit together there."""

    chain: Chain
    graph: Graph
    solution: Solution
    goodness: Goodness

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


class _BuiltUp(NamedTuple):
    """What is known of a chain as far as it has been built up."""

    poses: FloatArray
    wheel_calibration: FloatArray
    tags: dict[TagKey, FloatArray]
    calibration: dict[Parameter, float]
    effort: float = 0.0


def solve_local_map(chain: Chain) -> LocalMap:
    """Solves the whole chain from where building up leads.

    Where the result does not fit together, other starts are tried, as long as there is effort left; the first that fits
    counts, else the one of least cost, whose `goodness` then says that it does not fit.

    Raises:
        OfflineError: the readings contradict each other so much that nothing comes of building up.
    """
    graph = build_graph([chain])
    keyframes = coarse_keyframes(chain)
    coarse = coarsened(chain, keyframes)
    known = _built_up(coarse)
    windows = fitted_windows(graph.problem)
    rng = np.random.default_rng(0)
    best: LocalMap | None = None
    left = _allowed_effort(chain)
    for _ in range(1 + _OTHER_STARTS):
        poses = refined(chain, keyframes, known.poses, known.wheel_calibration)
        solution = solve(graph.problem, graph.start(poses, known.tags, known.calibration))
        if best is None or solution.cost < best.solution.cost:
            best = LocalMap(chain, graph, solution, windows.judge(solution.state))
            if best.goodness.fits:
                break
        left -= known.effort + _effort(solution)
        if left < 0.0:
            break
        known = _built_up(_redrawn(coarse, rng))
    if best is None:
        raise ValueError(f"{chain.name}: no start was tried")
    return best


def _redrawn(chain: Chain, rng: np.random.Generator) -> Chain:
    """The chain with one more draw of the wheels' noise: as likely a drive, whose valleys lie elsewhere."""
    odometry = chain.odometry
    error = np.linalg.cholesky(odometry.covariance) @ rng.standard_normal((len(odometry), 3, 1))
    return replace(chain, odometry=replace(odometry, motion=se2.compose(odometry.motion, se2.exp(error[..., 0]))))


def _built_up(chain: Chain) -> _BuiltUp:
    """Solves the chain piece by piece, each from the solution of the last."""
    known = _BuiltUp(np.zeros((1, 3)), np.zeros(3), {}, {})
    n_linearised = 0
    for n_solved, n_keyframes in enumerate(_pieces(chain), start=1):
        part = chain.prefix(n_keyframes)
        graph = build_graph([part])
        poses = _extended(part, known.poses, known.wheel_calibration)
        start = graph.start(poses, known.tags, known.calibration)
        solution = solve(graph.problem, start, _PIECE_COST_TOLERANCE)
        n_linearised += solution.n_linearised
        state, effort = solution.state, known.effort + _effort(solution)
        if effort > _allowed_effort(chain) and n_linearised > _MOST_STEPS * n_solved:
            raise OfflineError(
                f"{chain.run.log}: {chain.name}: its wheels and tag readings contradict each other all along "
                f"({n_linearised / n_solved:.0f} steps of the solver a piece, limit {_MOST_STEPS}; a drive takes 4); "
                "are robot.yaml and the camera's calibration those of this robot?"
            )
        wheels, tags = graph.wheel_calibration(state, 0), graph.tags_of(state)
        known = _BuiltUp(state.poses, wheels, tags, graph.calibration_of(state), effort)
    return known


def _allowed_effort(chain: Chain) -> float:
    return _FREE_EFFORT + _EFFORT_PER_BYTE * chain.run.log_bytes


def _effort(solution: Solution) -> float:
    """How many factors were linearised."""
    problem = solution.problem
    return float(solution.n_linearised * (len(problem.odometry.first) + len(problem.readings.tag)))


def _pieces(chain: Chain) -> list[int]:
    """Numbers of keyframes at which to stop and solve; the last is all of them."""
    ends, last_m = [], 0.0
    for keyframe, along_m in enumerate(np.cumsum(chain.odometry.distance_m).tolist(), start=1):
        if along_m - last_m >= max(_PIECE_M, _PIECE_SHARE * along_m):
            ends.append(keyframe)
            last_m = along_m
    return [*ends, len(chain.stamps_ns)]


def _extended(part: Chain, poses: FloatArray, wheel_calibration: FloatArray) -> FloatArray:
    """Poses of a longer chain: those known, then dead reckoning from the last one."""
    n_known = len(poses)
    rest = part.odometry.motion[n_known - 1 :]
    if not len(rest):
        return poses
    rest = se2.compose(rest, se2.exp(part.odometry.jacobian[n_known - 1 :] @ wheel_calibration))
    return np.concatenate([poses, chained(rest, poses[-1])[1:]])
