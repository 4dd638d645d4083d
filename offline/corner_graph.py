"""From a solved map of the floor to the problem of refining it on tag corners."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np

from calib import wheels
from calib.arrays import BoolArray, FloatArray, IntArray
from calib.camera_model import CameraModel
from calib.tag_edges import outward
from offline.chain import Chain
from offline.corner_calibrated_start import calibrated
from offline.corner_factors import CORNER_MOUNT, FOCAL_SCALE, CornerFactors, Looks, SpatialState
from offline.corner_problem import CornerProblem, columns_of
from offline.corner_sides import facing_as_predicted
from offline.corner_start import tags_hung
from offline.factors import CalibrationPrior, ReadingFactors, State
from offline.graph import Graph, Parameter, camera_parameters_of, mount_parameters_of, scale_parameter_of
from offline.upright import NOTHING_UPRIGHT, UprightFactors

_CORNER_NOISE: Final = "sigma_corner_px"


@dataclass(frozen=True)
class CornerGraph:
    """A problem on corners and what its variables mean.

    Attributes:
        graph: of the floor: its chains, poses, tags, and the first of the parameters, are the same.
        parameters: in order; those of the graph, then what only corners depend on.
    """

    problem: CornerProblem
    graph: Graph
    parameters: tuple[Parameter, ...]

    @property
    def is_hung(self) -> BoolArray:
        """(T,) which tags have a height and an orientation."""
        return np.asarray(self.problem.columns.heights >= 0)

    def height_of(self, chain: int) -> int | None:
        """Index of the height of one chain's camera among the parameters; None where no corners were kept."""
        height = _height_parameter(self.graph.chains[chain])
        return self.parameters.index(height) if height in self.parameters else None


def has_corners(graph: Graph) -> bool:
    """Whether any reading of the graph came from corners that the log still has."""
    return any(_from_corners(chain).any() for chain in graph.chains)


def corner_graph(
    graph: Graph, state: State, wobble_sigma: FloatArray | None = None, upright_sigma_rad: float | None = None
) -> tuple[CornerGraph, SpatialState]:
    """The problem, and its start: the floor's solution with every tag hung, and cameras mounted, as looks have it.

    Args:
        graph: of the floor; a reading of it stands for each look.
        state: its solution.
        wobble_sigma: (3,) how far off level pictures are; None: not at all.
        upright_sigma_rad: to which tags are known to hang upright; None: they may hang anyhow.
    """
    chains, masks = graph.chains, [_from_corners(chain) for chain in graph.chains]
    seeing = [chain for chain, mask in zip(chains, masks, strict=True) if mask.any()]
    of_corners = sorted({each for chain in seeing for each in (_height_parameter(chain), _focal_parameter(chain))})
    parameters = (*graph.parameters, *of_corners)
    looks, cameras = _looks(graph, parameters, masks)
    floor = graph.problem
    n_tags = len(graph.tags)
    seen = np.bincount(looks.tag, minlength=n_tags) > 0
    kept = ~np.concatenate(masks)
    sigmas = np.array([parameter.sigma for parameter in parameters])
    problem = CornerProblem(
        odometry=floor.odometry,
        corners=CornerFactors(looks, cameras),
        readings=_readings_where(floor.readings, kept),
        prior=CalibrationPrior(sigmas),
        measured=floor.measured,
        columns=columns_of(len(state.poses), seen, sigmas),
        anchor=floor.anchor,
        wobble_sigma=np.zeros(3) if wobble_sigma is None else wobble_sigma,
        upright=NOTHING_UPRIGHT
        if upright_sigma_rad is None
        else UprightFactors(np.flatnonzero(seen), upright_sigma_rad),
    )
    start = SpatialState(
        poses=state.poses,
        tags=state.tags,
        calibration=np.concatenate([state.calibration, np.zeros(len(of_corners))]),
        heights_m=np.where(seen, np.nan, 0.0),
        turns=np.where(seen[:, None, None], np.nan, np.eye(3)),
    )
    start = calibrated(problem, tags_hung(problem, start))
    problem = replace(problem, corners=facing_as_predicted(problem.corners, start))
    vars(problem)["motions"] = floor.arrowhead.odometry  # where the property has it: they rise by pose in a graph
    return CornerGraph(problem, graph, parameters), start


def _from_corners(chain: Chain) -> BoolArray:
    """(M,) which of a chain's readings have corners."""
    return np.asarray(np.isfinite(chain.readings.corners_px).all((-1, -2)))


def _looks(
    graph: Graph, parameters: Sequence[Parameter], masks: Sequence[BoolArray]
) -> tuple[Looks, tuple[CameraModel, ...]]:
    """Those readings of each chain that have corners, and the cameras."""
    cameras: list[CameraModel] = []
    found = []
    index = {parameter: i for i, parameter in enumerate(parameters)}
    tag_index = {tag: i for i, tag in enumerate(graph.tags)}
    for chain, mask, first_pose in zip(graph.chains, masks, graph.first_pose.tolist(), strict=True):
        camera = chain.run.camera
        if camera is None or not mask.any():
            continue
        if camera not in cameras:
            cameras.append(camera)
        robot, readings = chain.run.robot, chain.readings.where(mask)
        n = len(readings)
        x, y, yaw = mount_parameters_of(robot)
        roll, pitch, time, edges = camera_parameters_of(chain)
        mount = [index[p] for p in (x, y, _height_parameter(chain), roll, pitch, yaw)]
        scales = np.array([index[scale_parameter_of(chain, tag)] for tag in chain.tags], dtype=np.int64)
        sides_m = np.array([robot.tag_size_m(tag.family, tag.tag_id)[0] for tag in chain.tags])
        own_tags = np.array([tag_index[tag] for tag in chain.tags], dtype=np.int64)
        unit = readings.parts.of((_CORNER_NOISE,))[0]
        by_corners = readings.covariance - readings.parts.rest
        variance = np.trace(by_corners, axis1=1, axis2=2) / np.trace(unit, axis1=1, axis2=2)
        moved, twist = _moved(chain, readings.keyframe, readings.corners_px, camera.height_px)
        nominal = [getattr(robot.mount, name.removeprefix("mount_")) for name in CORNER_MOUNT]
        found.append(
            Looks(
                pose=first_pose + readings.keyframe,
                tag=own_tags[readings.tag],
                corners_px=readings.corners_px,
                sigma_px=np.sqrt(variance) * readings.corner_sigmas,
                side_m=sides_m[readings.tag],
                camera=np.full(n, cameras.index(camera)),
                moved=moved,
                twist=twist,
                mount=np.tile(nominal, (n, 1)),
                mount_parameters=np.tile(mount, (n, 1)),
                time_parameter=np.full(n, index[time]),
                scale_parameter=scales[readings.tag],
                focal_parameter=np.full(n, index[_focal_parameter(chain)]),
                edge_parameter=np.full(n, index[edges]),
                outward=outward(readings.corners_px),
            )
        )
    whole = Looks(*(np.concatenate([getattr(each, field.name) for each in found]) for field in fields(Looks)))
    return whole, tuple(cameras)


def _moved(chain: Chain, keyframe: IntArray, corners_px: FloatArray, height_px: int) -> tuple[FloatArray, FloatArray]:
    """How base moved by the wheels (M, 4, 3) from a keyframe to when each corner's row was read, and its twist (M, 3).

    A stamp is that of the middle row.
    """
    robot = chain.run.robot
    stamps_ns = chain.stamps_ns[keyframe]
    track = next(each for each in chain.run.stretches if each.stamps_ns[0] <= stamps_ns[0] <= each.stamps_ns[-1])
    speed, turning = track.twist_at(stamps_ns, robot.wheels.track_m).T
    twist = np.stack([speed, np.zeros_like(speed), turning], axis=-1)
    if robot.readout_s == 0.0:  # all rows at once
        return np.zeros((*corners_px.shape[:-1], 3)), twist
    share = np.clip(corners_px[..., 1] / (height_px - 1) - 0.5, -0.5, 0.5)
    rows_ns = stamps_ns[:, None] + np.rint(share * robot.readout_s * 1e9).astype(np.int64)
    left_m, right_m = (
        at_row - at_stamp[:, None] for at_row, at_stamp in zip(track.at(rows_ns), track.at(stamps_ns), strict=True)
    )
    return wheels.advance(left_m, right_m, robot.wheels.track_m), twist


def _height_parameter(chain: Chain) -> Parameter:
    mount = chain.run.robot.mount
    return Parameter(chain.run.robot_id, "mount_z_m", (mount.z_m,), mount.z_m_sigma)


def _focal_parameter(chain: Chain) -> Parameter:
    """Held where robot.yaml gives it no sigma."""
    run = chain.run
    nominal = () if run.camera is None else (run.camera.fx_px, run.camera.fy_px)
    return Parameter(run.robot_id, FOCAL_SCALE, nominal, run.robot.focal_scale_sigma)


def _readings_where(readings: ReadingFactors, kept: BoolArray) -> ReadingFactors:
    return ReadingFactors(*(getattr(readings, field.name)[kept] for field in fields(ReadingFactors)))
