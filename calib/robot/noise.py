"""The noise parameters of the simulator, the estimator, `--noise` and map.json."""

import math
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from groundsbot.calib.foundation import parse_mapping, read_text, validate

# Wider than any real value, and within the range in which sums of squares neither overflow nor underflow.
Sigma = Annotated[float, Field(ge=1e-9, le=1e3)]


class NoiseParameters(BaseModel):
    """Standard deviations of wheel odometry and tag observations.

    A step of length d and turn a has, in the frame of its end, the variances var_x = sigma_distance^2 |d|,
    var_y = sigma_lateral^2 |d|, var_theta = sigma_heading_rad_per_sqrt_m^2 |d| + sigma_heading_rad_per_sqrt_rad^2 |a|.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    sigma_distance_m_per_sqrt_m: Sigma = 0.01
    sigma_lateral_m_per_sqrt_m: Sigma = 0.002
    sigma_heading_rad_per_sqrt_m: Sigma = math.radians(0.6)
    sigma_heading_rad_per_sqrt_rad: Sigma = 0.02
    sigma_corner_px: Sigma = 0.2
    # For tag positions without a covariance. They are large, because such positions contain the bias of a planar pose
    # (percents of the range for a small frontal tag) and the effect of late stamps.
    sigma_range_m: Sigma = 0.05
    sigma_range_per_m: Sigma = 0.03  # share of the range, added in quadrature
    sigma_bearing_rad: Sigma = math.radians(1.0)
    sigma_stamp_s: Sigma = 0.01  # independent for each stamp, as from a detector's queue or a slow loop


def read_noise_yaml(path: Path) -> NoiseParameters:
    """Return the parameters of a YAML file; missing ones have their defaults.

    Raises:
        CalibError: the file is unreadable or has an invalid value.
    """
    return validate(NoiseParameters, parse_mapping(read_text(path), str(path)), str(path))
