"""The calibration of the model, and its heavy-tailed priors about robot.yaml."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS, MOUNT_PARAMETERS, Robot, camera_parameter
from groundsbot.offline.estimate.drive import Drive
from groundsbot.offline.sam import (
    mount_parameters_of,
    odometry_parameters_of,
    parameter_of_scale,
    parameters_of_camera,
    parameters_of_wheels,
)

DISTANCE: Final = "distance"
TURN_LEFT: Final = "turn_left"
TURN_RIGHT: Final = "turn_right"
RATIO: Final = "wheel_ratio"
TURN_LOSS: Final = "turn_loss"
RANGE_SCALE: Final = "range_scale"
DEPTH: Final = "depth_exponent"
KIND: Final = "robots of one kind"

_TURNS_ALIKE: Final = 0.05  # sigma of the difference between turns to the left and to the right
# A camera that measures depth has the exponent 1, one that measures range 0; an import does not say.
_DEPTH_PRIOR: Final = (0.5, 0.7)
_DEPTH_WIDEST_RAD: Final = 1.2  # nothing that sees farther to the side measures depth
_N_MOST: Final = 3  # terms of a prior


class Owned(NamedTuple):
    """A parameter: the robot or printed batch that it is of, and its name."""

    owner: str
    name: str


class Prior(NamedTuple):
    """A Student-t prior on a sum of parameters: (sum of coefficients times values - mean) / sigma."""

    terms: tuple[tuple[Owned, float], ...]
    sigma: float
    mean: float = 0.0


@dataclass
class CalibrationModel:
    """All parameters of some drives. The first one is fixed at zero; readings that depend on nothing refer to it.

    Attributes:
        names: parameters in order.
        priors: priors.
        start: initial values where these are not zero.
    """

    names: list[Owned] = field(default_factory=lambda: [Owned("", "")])
    priors: list[Prior] = field(default_factory=list)
    start: dict[Owned, float] = field(default_factory=dict)

    def index(self, wanted: Owned) -> int:
        """Return the index of a parameter; 0 for one that there is not."""
        return self._indices.get(wanted, 0)

    @property
    def values(self) -> FloatArray:
        """Initial values (C,)."""
        return np.array([self.start.get(each, 0.0) for each in self.names])

    def arrays(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return the priors: (R, 4) parameters, (R, 4) coefficients over sigma, (R,) means over sigma.

        The last parameter is the stretch, with the coefficients of all that it adds to.
        """
        stretched = self.scaled_with_map
        indices, rows, means = (
            np.zeros((len(self.priors), _N_MOST + 1), dtype=np.int64),
            np.zeros((len(self.priors), _N_MOST + 1)),
            np.zeros(len(self.priors)),
        )
        for i, prior in enumerate(self.priors):
            for k, (name, coefficient) in enumerate(prior.terms):
                indices[i, k], rows[i, k] = self.index(name), coefficient / prior.sigma
                if self.index(name) in stretched:
                    rows[i, -1] += coefficient / prior.sigma
            indices[i, -1] = self.map_scale if rows[i, -1] else 0
            means[i] = prior.mean / prior.sigma
        return indices, rows, means

    def __post_init__(self) -> None:
        self._indices = {each: i for i, each in enumerate(self.names)}

    @property
    def map_scale(self) -> int:
        """Index of the first ln distance, a change of which stretches all; 0 without any."""
        return next((i for i, each in enumerate(self.names) if each.name == DISTANCE), 0)

    @property
    def scaled_with_map(self) -> IntArray:
        """Indices of all other ln distances, to which a change of the stretch adds."""
        return np.array(
            [i for i, each in enumerate(self.names) if each.name == DISTANCE and i != self.map_scale], dtype=np.int64
        )

    def add(self, name: Owned, sigma: float | None = None, mean: float = 0.0) -> Owned:
        """Add a parameter, with a prior of its own if it has a sigma, unless it is there; return its name."""
        if name not in self._indices:
            self._indices[name] = len(self.names)
            self.names.append(name)
            if sigma is not None:
                self.priors.append(Prior(((name, 1.0),), sigma, mean))
            if mean:
                self.start[name] = mean
        return name


def calibration_of(drives: Sequence[Drive]) -> CalibrationModel:
    """Return the parameters and priors of some drives."""
    found = CalibrationModel()
    for drive in drives:
        _add_wheels(found, drive)
        for camera in drive.segment.run.robot.camera_names:
            _add_camera(found, drive, camera)
    return found


def wheel_names(drive: Drive) -> list[Owned]:
    """Return the parameters of a drive's motions: distance, then those of `wheel_jacobian`."""
    robot = drive.segment.run.robot
    own = [Owned(robot.robot_id, name) for name in (DISTANCE, TURN_LEFT, TURN_RIGHT, RATIO, TURN_LOSS)]
    return own + [Owned(each.owner, each.name) for each in odometry_parameters_of(drive.segment)[3:]]


def reading_names(robot: Robot, camera: str, batch: str) -> list[Owned]:
    """Return the parameters of a camera's readings of a batch of tags, as READING_PARAMETERS but for the stretch."""
    roll, pitch, late, edge, offset = CAMERA_PARAMETERS
    of_camera = [*MOUNT_PARAMETERS, late]
    own = [Owned(robot.robot_id, camera_parameter(name, camera)) for name in of_camera]
    scale, depth = (Owned(robot.robot_id, camera_parameter(name, camera)) for name in (RANGE_SCALE, DEPTH))
    linear = [Owned(robot.robot_id, camera_parameter(name, camera)) for name in (roll, pitch, edge)]
    distance = Owned(robot.robot_id, DISTANCE)
    return [*own, Owned(robot.robot_id, offset), scale, depth, Owned(batch, "tag_scale"), *linear, distance]


def _add_wheels(found: CalibrationModel, drive: Drive) -> None:
    robot = drive.segment.run.robot
    distance = Owned(robot.robot_id, DISTANCE)
    scale, ratio, track = parameters_of_wheels(robot)
    if distance not in found.names:
        found.add(distance)
        if robot.is_left_open:  # what nobody measured is wrong alike in robots of one kind
            common = found.add(Owned(KIND, DISTANCE), scale.sigma / 2**0.5)
            found.priors.append(Prior(((distance, 1.0), (common, -1.0)), scale.sigma / 2**0.5))
        else:
            found.priors.append(Prior(((distance, 1.0),), scale.sigma))
        left, right = (found.add(Owned(robot.robot_id, name)) for name in (TURN_LEFT, TURN_RIGHT))
        found.priors.append(Prior(((distance, 1.0), (left, -0.5), (right, -0.5)), track.sigma))
        found.priors.append(Prior(((left, 1.0), (right, -1.0)), _TURNS_ALIKE))
        found.add(Owned(robot.robot_id, RATIO), ratio.sigma)
        # By as much in a turn about one wheel as distances are off otherwise.
        found.add(Owned(robot.robot_id, TURN_LOSS), robot.wheels.track_m * scale.sigma)
    for each in odometry_parameters_of(drive.segment)[3:]:
        found.add(Owned(each.owner, each.name), each.sigma)


def _add_camera(found: CalibrationModel, drive: Drive, camera: str) -> None:
    robot, observations = drive.segment.run.robot, drive.segment.observations
    own = observations.camera == robot.camera_names.index(camera)
    if not own.any():
        return
    mounts, of_camera = mount_parameters_of(robot, camera), parameters_of_camera(robot, camera)
    if observations.in_camera[own].any():
        for each in mounts:
            found.add(Owned(each.owner, each.name), each.sigma)
    for k, each in enumerate(of_camera):
        if each.sigma > 0.0 and observations.by_camera[own][..., k].any():
            found.add(Owned(each.owner, each.name), each.sigma)
    batches = [parameter_of_scale(robot, drive.segment.tags[tag]) for tag in np.unique(observations.tag[own])]
    for each in batches:
        found.add(Owned(each.owner, each.name), each.sigma)
    is_imported = ~observations.from_corners[own]
    if not is_imported.all():
        return
    found.add(Owned(robot.robot_id, camera_parameter(RANGE_SCALE, camera)), robot.imported_tag_scale_sigma)
    given = drive.segment.run.positions.polar
    is_range = bool(given.all()) if len(given) else bool(observations.polar[own].all())
    if is_range and np.abs(observations.value[own][:, 1]).max() < _DEPTH_WIDEST_RAD:
        mean, sigma = _DEPTH_PRIOR
        found.add(Owned(robot.robot_id, camera_parameter(DEPTH, camera)), sigma, mean)
