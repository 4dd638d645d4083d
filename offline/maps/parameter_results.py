"""What mapping tells of the numbers that it took from robot.yaml and of the noise: typed, in SI units."""

from dataclasses import dataclass
from typing import Final

import numpy as np

NOT_NEEDED: Final = "no measurement depends on it"


# What is right goes beyond this once in 16,000 times.
MAX_SIGMAS: Final = 4.0


@dataclass(frozen=True)
class CalibrationResult:
    """One calibration number that the solve carried, as a correction to what robot.yaml says."""

    owner: str  # robot id, or the printed batch of tags
    name: str  # wheel_scale, wheel_ratio, track_scale, mount_x_m, mount_y_m, mount_yaw_rad, tag_scale
    component: int
    value: float
    sigma: float
    prior_sigma: float


@dataclass(frozen=True)
class CalibrationChoice:
    """Whether self-calibration freed one number of robot.yaml, and why not.

    Attributes:
        owner: robot id, or the printed batch of tags.
        name: as in CalibrationResult.
        value: the correction by the drives alone, with its sigma.
        prior_sigma: what robot.yaml says of it.
        off_sigmas: how far drives and robot.yaml differ.
        held_out_gain: log likelihood of each segment by what the other segments tell, over that by robot.yaml; summed.
            None where no two segments tell anything of it.
        reason: why it stays as robot.yaml has it; empty where it is freed.
        is_asked: it was asked for by its name.
    """

    owner: str
    name: str
    is_freed: bool
    value: float
    sigma: float
    prior_sigma: float
    off_sigmas: float
    held_out_gain: float | None
    reason: str
    is_asked: bool = False


@dataclass(frozen=True)
class RobotNumber:
    """What drives say of one number of a robot's file.

    Attributes:
        owner: robot id, or the printed batch of tags.
        name: as in CalibrationResult.
        component: whose solve found it.
        what: the field of robot.yaml, or what the number is, with its unit.
        in_file: as the file has it.
        found: by the map, with its sigma.
        verdict: what to think of the file.
        to_do: what to do about it; empty for nothing.
    """

    owner: str
    name: str
    component: int
    what: str
    in_file: float
    found: float
    sigma: float
    verdict: str
    to_do: str


@dataclass(frozen=True)
class ConsistencyCheck:
    """Two ways to know one thing, held against each other: wheels and tags."""

    name: str  # scale: how much longer a metre by the tags is than one by the wheels; turn: likewise a full turn
    component: int
    robot_id: str
    batch: str | None  # of tags; None for a turn, which needs no sizes
    value: float  # as a share, by readings alone: without the priors
    sigma: float
    prior_sigma: float  # how far the two may differ by what robot.yaml says

    @property
    def sigmas(self) -> float:
        """How far they differ, in sigmas of what readings and robot.yaml allow."""
        return abs(self.value) / float(np.hypot(self.sigma, self.prior_sigma))

    @property
    def contradicts(self) -> bool:
        """By more than chance allows."""
        return self.sigmas > MAX_SIGMAS


@dataclass(frozen=True)
class ScaleBudget:
    """What holds the length of a metre in a component: wheels, tags and all places could be stretched together."""

    component: int
    sigma: float  # relative
    shares: dict[str, float]  # of wheels, track, tags, mount, distances, starts; they add up to 1


@dataclass(frozen=True)
class FittedParameter:
    """One noise parameter, and what the runs told of it."""

    name: str  # as in NoiseParameters
    value: float
    low: float | None  # where it lies with 99 %; None where it was not fitted
    high: float | None
    redundancy: float  # of how many squared residuals of its own it is the mean
    kept: str = ""  # why it stands at its prior; empty where it was fitted


@dataclass(frozen=True)
class FittedNoise:
    """Where the noise comes from when nobody gave it."""

    parameters: tuple[FittedParameter, ...]
    # Variances of errors that readings of a tag share, as multiples of what the default noise gives: forgotten along
    # the way, over 0.25 m or 1 rad, and lasting for a pass.
    shared_range: float
    shared_bearing: float
    pass_range: float
    pass_bearing: float
    runs: tuple[str, ...]  # names of those that it was fitted to
    contradicting: tuple[str, ...]  # of those that contradict themselves: under the prior, or this where it is larger
