"""Refinement of a solved planar map on the corners of its tags, or the reasons against it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import FloatArray, IntArray
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

# The breakdown point of Huber's estimate is below one half.
_MOST_OUTLIERS: Final = 0.5
_FEW_OUTLIERS: Final = 0.05
_NOT_REFINED: Final = "not refined on tag corners: {}; the map has planar tag positions only"
# Pairs of detections that share an image of an uneven floor take ten kilobytes each. A drive with ten tags in each
# image records twice as many bytes for each pair.
_FREE_PAIRS: Final = 5000
_BYTES_A_PAIR: Final = 64
# Limit on the size of the square-root factor; a drive through a hall needs a twentieth of it. Joint covariances of the
# tags need a third as much in addition.
_FREE_FACTOR_BYTES: Final = 32 << 20
_FACTOR_BYTES_PER_BYTE: Final = 64


@dataclass(frozen=True)
class Refined:
    """A solved map, refined on corners."""

    corners: CornerGraph
    solution: CornerSolution

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Calibration parameters, in order."""
        return self.corners.parameters

    @property
    def floor(self) -> FloorSigmas:
        """Sigmas of tilt and height of the floor; roll and pitch have the same sigma."""
        tilt_rad, _, height_m = self.solution.problem.attitude_sigmas.tolist()
        return FloorSigmas(tilt_rad, height_m)

    @property
    def tag_poses(self) -> Sequence[TagPose | None]:
        """Pose of each tag in map with its covariance; None for tags without corners."""
        state, columns = self.solution.state, self.solution.problem.columns
        six = np.column_stack([columns.tags, columns.heights, columns.turns])
        quaternions = Rotation.from_matrix(state.turns).as_quat(canonical=True)
        found: list[TagPose | None] = []
        for t, has_pose in enumerate(self.corners.has_pose.tolist()):
            to_map = np.eye(6)
            to_map[3:, 3:] = state.turns[t]  # R exp(d) = exp(R d) R
            pose = TagPose(
                float(state.heights_m[t]), quaternions[t], to_map @ self.solution.covariance(six[t]) @ to_map.T
            )
            found.append(pose if has_pose else None)
        return found

    def attitudes_with(self, columns: IntArray) -> FloatArray:
        """Return the covariance (T, 4, k) of each tag's height and rotation about map's axes with k columns."""
        state, own = self.solution.state, self.solution.problem.columns
        four = np.column_stack([own.heights, own.turns])
        joint = self.solution.covariance(np.concatenate([four.reshape(-1), columns]))
        attitudes = joint[: four.size, four.size :].reshape(len(four), 4, -1)
        attitudes[:, 1:] = state.turns @ attitudes[:, 1:]  # R exp(d) = exp(R d) R
        return attitudes

    def mounts_of(self, state: State, segment: int) -> dict[str, Mount]:
        """Return the corrected mounts of one segment's cameras by name; empty for a log without a camera."""
        mounts = self.corners.graph.mounts_of(state, segment)
        for name, height in self.corners.heights_of(segment).items():
            if name in mounts:
                z_m = mounts[name].z_m + float(state.calibration[height])
                mounts[name] = mounts[name].model_copy(update={"z_m": z_m})
        return mounts


def refine(
    graph: Graph, solution: Solution, upright_sigma_rad: float | None = None
) -> tuple[Refined | None, list[str]]:
    """Minimise the distances in pixels between observed and predicted corners, from a planar solution.

    Args:
        graph: planar graph.
        solution: its solution.
        upright_sigma_rad: sigma to which tags are known to be mounted upright; None if they are not.

    Returns:
        The refined map, or None, and warnings: why the map was not refined, tags that are not upright, and parts of
        drives that are not level.
    """
    if not solution.converged:
        return None, []  # the map has a warning already
    corners, start = corner_graph(graph, solution.state, upright_sigma_rad=upright_sigma_rad)
    if reason := _too_large(graph, corners.problem):
        return None, [_NOT_REFINED.format(reason)]
    found = solve_corners(corners.problem, start)
    if found.pictures.outliers > _FEW_OUTLIERS:  # with a wrong mount, the wrong one of a tag's two poses may fit first
        again = solve_corners(corners.problem, with_alternative_tag_poses(corners.problem, found.state))
        found = again if again.cost < found.cost else found
    too_many = _reason_for_level_floor(graph, found)
    sigma = LEVEL if too_many else initial_attitude_sigmas(found.problem, found.state, found.factor, found.pictures)
    if sigma.any():  # a level solution fits poorly: solve with initial sigmas before fitting them
        found = solve_corners(with_attitude_sigmas(found.problem, sigma), found.state)
        found = solve_corners(found.problem, with_alternative_tag_poses(found.problem, found.state))
        sigma = fit_attitude_sigmas(found.problem, found.state)
        found = solve_corners(with_attitude_sigmas(found.problem, sigma), found.state)
    off_level = [*too_many, *segments_off_level(graph, found)]
    reason = "" if found.converged else found.reason
    if not reason and (share := found.pictures.outliers) > _MOST_OUTLIERS:
        reason = (
            f"{100.0 * share:.0f} % of the tag detections are outliers; check that camera.yaml belongs to this camera"
        )
    if reason:
        return None, [*off_level, _NOT_REFINED.format(reason)]
    return Refined(corners, found), found.problem.upright.warnings(found.state, graph.tags) + off_level


def _too_large(graph: Graph, problem: CornerProblem) -> str:
    """Return why the factor is too large for the logs, with a remedy; empty if it is not."""
    n_bytes, factor_bytes = _log_bytes(graph), problem.order.n_bytes
    most = _FREE_FACTOR_BYTES + _FACTOR_BYTES_PER_BYTE * n_bytes
    if not n_bytes or factor_bytes <= most:
        return ""
    return (
        f"the factor of {len(graph.tags)} tags that share images would take {factor_bytes >> 20} MiB, limit "
        f"{most >> 20} MiB for logs of {n_bytes} bytes (check the tags' ids)"
    )


def _log_bytes(graph: Graph) -> int:
    """Return the size of all logs of a graph, in bytes."""
    return sum(run.log_bytes for run in {segment.run.name: segment.run for segment in graph.segments}.values())


def _reason_for_level_floor(graph: Graph, found: CornerSolution) -> list[str]:
    """Return a warning that the floor is assumed level, if fitting its sigmas takes too much work for the logs."""
    n_pairs, n_bytes = found.problem.n_pairs_in_pictures, _log_bytes(graph)
    most = _FREE_PAIRS + n_bytes // _BYTES_A_PAIR
    if not n_bytes or n_pairs <= most:
        return []
    sentence = (
        f"the floor is assumed level: {n_pairs} pairs of tags share an image, limit {most} for logs of {n_bytes} "
        "bytes; leave out some of the detections"
    )
    return [sentence]
