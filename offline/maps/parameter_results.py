"""Results on the parameters from robot.yaml and on the noise: typed, in SI units."""

from dataclasses import dataclass
from typing import Final

import numpy as np

NOT_NEEDED: Final = "no measurement depends on it"


# A correct value exceeds this with a probability of 1 in 16,000.
MAX_SIGMAS: Final = 4.0


@dataclass(frozen=True)
class CalibrationResult:
    """Estimate of one calibration parameter, as a correction to robot.yaml."""

    owner: str  # robot id, or the printed batch of tags
    name: str  # wheel_scale, wheel_ratio, track_scale, mount_x_m, mount_y_m, mount_yaw_rad, tag_scale
    component: int
    value: float
    sigma: float
    prior_sigma: float


@dataclass(frozen=True)
class CalibrationChoice:
    """Whether self-calibration freed one parameter of robot.yaml, and why not.

    Attributes:
        owner: robot id, or the printed batch of tags.
        name: name as in CalibrationResult.
        value: the correction by the drives alone, with its sigma.
        prior_sigma: prior sigma of robot.yaml.
        off_sigmas: deviation of the drives from robot.yaml.
        held_out_gain: sum over segments of the log likelihood ratio of the estimate from the other segments to
            robot.yaml. None if fewer than two segments determine it.
        reason: why it stays as in robot.yaml; empty if it is freed.
        is_asked: it was requested by name.
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
    """Estimate of one parameter of a robot's file, compared with the file.

    Attributes:
        owner: robot id, or the printed batch of tags.
        name: name as in CalibrationResult.
        component: component whose solve estimated it.
        what: the field of robot.yaml, or a description of the parameter, with its unit.
        in_file: the file's value.
        found: the map's estimate, with its sigma.
        verdict: assessment of the file's value.
        to_do: what to do about it; empty for nothing.
        unit: m, rad, s or px; empty for ratios, and in maps of older programs.
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
    unit: str = ""


@dataclass(frozen=True)
class ConsistencyCheck:
    """Comparison of two independent estimates of one quantity, by wheels and by tags."""

    name: str  # scale: excess of a metre by the tags over one by the wheels; turn: likewise of a full turn
    component: int
    robot_id: str
    batch: str | None  # of tags; None for a turn, which needs no sizes
    value: float  # relative, from the observations without priors
    sigma: float
    prior_sigma: float  # of their difference by robot.yaml

    @property
    def sigmas(self) -> float:
        """Difference in sigmas of observations and robot.yaml together."""
        return abs(self.value) / float(np.hypot(self.sigma, self.prior_sigma))

    @property
    def contradicts(self) -> bool:
        """Whether they differ by more than chance allows."""
        return self.sigmas > MAX_SIGMAS


@dataclass(frozen=True)
class ScaleBudget:
    """Contributions to the scale of a component; wheels, tags and positions could be scaled together."""

    component: int
    sigma: float  # relative
    shares: dict[str, float]  # of wheels, track, tags, mount, distances, starts; their sum is 1


@dataclass(frozen=True)
class FittedParameter:
    """One noise parameter, and how the runs determined it."""

    name: str  # as in NoiseParameters
    value: float
    low: float | None  # 99 % interval; None if it was not fitted
    high: float | None
    redundancy: float  # degrees of freedom of the residuals that it is fitted to
    kept: str = ""  # why it stays at its prior; empty if it was fitted


@dataclass(frozen=True)
class FittedNoise:
    """Noise estimated from the runs."""

    parameters: tuple[FittedParameter, ...]
    # Variances of correlated errors of a tag's observations, relative to those of the default noise: with a correlation
    # length of 0.25 m or 1 rad, and constant over a pass.
    shared_range: float
    shared_bearing: float
    pass_range: float
    pass_bearing: float
    runs: tuple[str, ...]  # names of those that it was fitted to
    contradicting: tuple[str, ...]  # inconsistent runs: they use the larger of the prior and this noise
