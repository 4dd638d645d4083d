"""A solved map of the floor, refined on the corners of its tags; or why that was not to be."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.robot import Mount
from groundsbot.offline.corners.floor_noise import (
    LEVEL,
    fit_attitude_sigmas,
    initial_attitude_sigmas,
    with_attitude_sigmas,
)
from groundsbot.offline.corners.floor_slope_test import segments_off_level
from groundsbot.offline.corners.graph import CornerGraph, corner_graph
from groundsbot.offline.corners.initial_tag_poses import with_alternative_tag_poses
from groundsbot.offline.corners.problem import CornerProblem
from groundsbot.offline.corners.solver import CornerSolution, solve_corners
from groundsbot.offline.maps import FloorSigmas, TagPose
from groundsbot.offline.sam import Graph, Parameter, Solution, State

# Huber's estimate bears less than half of its looks being wrong; beyond that it tells nothing.
_MOST_OUTLIERS: Final = 0.5
_NOT_REFINED: Final = "not refined on tag corners: {}; the map is that of tag positions on the floor"
# Looks that share a picture which may stand off level, ten kilobytes a pair. A drive that sees ten tags in each of its
# pictures records twice as much for each pair.
_FREE_PAIRS: Final = 5000
_BYTES_A_PAIR: Final = 64
# What a factor on corners may take: a drive through a hall takes a twentieth of it. Beside it joint covariances of the
# tags take a third as much.
_FREE_FACTOR_BYTES: Final = 32 << 20
_FACTOR_BYTES_PER_BYTE: Final = 64


@dataclass(frozen=True)
class Refined:
    """What corners made of a solved map."""

    corners: CornerGraph
    solution: CornerSolution

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Calibration numbers, in order."""
        return self.corners.parameters

    @property
    def floor(self) -> FloorSigmas:
        """How uneven the floor is; a floor rolls and pitches alike."""
        tilt_rad, _, height_m = self.solution.problem.attitude_sigmas.tolist()
        return FloorSigmas(tilt_rad, height_m)

    @property
    def tag_poses(self) -> Sequence[TagPose | None]:
        """How each tag hangs; None for those of which no corners were kept."""
        state, columns = self.solution.state, self.solution.problem.columns
        six = np.column_stack([columns.tags, columns.heights, columns.turns])
        quaternions = Rotation.from_matrix(state.turns).as_quat(canonical=True)
        found: list[TagPose | None] = []
        for t, is_hung in enumerate(self.corners.has_pose.tolist()):
            to_map = np.eye(6)
            to_map[3:, 3:] = state.turns[t]  # R exp(d) = exp(R d) R
            pose = TagPose(
                float(state.heights_m[t]), quaternions[t], to_map @ self.solution.covariance(six[t]) @ to_map.T
            )
            found.append(pose if is_hung else None)
        return found

    def mount_of(self, state: State, segment: int) -> Mount | None:
        """Where one segment's camera sits, as corrected; None for a log without a camera."""
        mount = self.corners.graph.mount_of(state, segment)
        height = self.corners.height_of(segment)
        if mount is None or height is None:
            return mount
        return mount.model_copy(update={"z_m": mount.z_m + float(state.calibration[height])})


def refine(
    graph: Graph, solution: Solution, upright_sigma_rad: float | None = None
) -> tuple[Refined | None, list[str]]:
    """Minimises the distance in pixels between corners seen and predicted, from the solution on the floor.

    Args:
        graph: of the floor.
        solution: of it.
        upright_sigma_rad: to which tags are known to hang upright; None: they may hang anyhow.

    Returns:
        What came of it, or None, and sentences that say why the map stays as it was, or which tags
        and segments of drives are not as they were taken to be.
    """
    if not solution.converged:
        return None, []  # the map says so already
    corners, start = corner_graph(graph, solution.state, upright_sigma_rad=upright_sigma_rad)
    if reason := _too_large(graph, corners.problem):
        return None, [_NOT_REFINED.format(reason)]
    found = solve_corners(corners.problem, start)
    too_many = _reason_for_level_floor(graph, found)
    sigma = LEVEL if too_many else initial_attitude_sigmas(found.problem, found.state, found.factor, found.pictures)
    if sigma.any():  # where all was taken for level nothing can be fitted well: first with sigmas of the right order
        found = solve_corners(with_attitude_sigmas(found.problem, sigma), found.state)
        found = solve_corners(found.problem, with_alternative_tag_poses(found.problem, found.state))
        sigma = fit_attitude_sigmas(found.problem, found.state)
        found = solve_corners(with_attitude_sigmas(found.problem, sigma), found.state)
    off_level = [*too_many, *segments_off_level(graph, found)]
    reason = "" if found.converged else found.reason
    if not reason and (share := found.pictures.outliers) > _MOST_OUTLIERS:
        reason = (
            f"{100.0 * share:.0f} % of the looks at tags do not fit; is the camera's calibration that of this camera?"
        )
    if reason:
        return None, [*off_level, _NOT_REFINED.format(reason)]
    return Refined(corners, found), found.problem.upright.leaning(found.state, graph.tags) + off_level


def _too_large(graph: Graph, problem: CornerProblem) -> str:
    """Why logs are not worth the memory of refining them, with the way out; else nothing."""
    n_bytes, factor_bytes = _log_bytes(graph), problem.order.n_bytes
    most = _FREE_FACTOR_BYTES + _FACTOR_BYTES_PER_BYTE * n_bytes
    if not n_bytes or factor_bytes <= most:
        return ""
    return (
        f"{len(graph.tags)} tags that pictures tie together would take {factor_bytes >> 20} MiB, limit "
        f"{most >> 20} MiB for logs of {n_bytes} bytes (are the tags' numbers right?)"
    )


def _log_bytes(graph: Graph) -> int:
    """Of all logs of a graph."""
    return sum(run.log_bytes for run in {segment.run.name: segment.run for segment in graph.segments}.values())


def _reason_for_level_floor(graph: Graph, found: CornerSolution) -> list[str]:
    """Why the floor is taken for level, where its logs are not worth the work of asking; no sentence else."""
    n_pairs, n_bytes = found.problem.n_pairs_in_pictures, _log_bytes(graph)
    most = _FREE_PAIRS + n_bytes // _BYTES_A_PAIR
    if not n_bytes or n_pairs <= most:
        return []
    sentence = (
        f"the floor is taken for level: {n_pairs} pairs of tags share a picture, limit {most} for logs of {n_bytes} "
        "bytes; leave out some of the looks"
    )
    return [sentence]
