"""The noise parameters, under one name in simulator, estimator, `--noise` and map.json."""

import math
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from groundsbot.calib.foundation import parse_mapping, read_text, validate

# Wider than anything that drives, and within what sums of squares can hold.
Sigma = Annotated[float, Field(ge=1e-9, le=1e3)]


class NoiseParameters(BaseModel):
    """Standard deviations of wheels and tag readings.

    Over a step of length d and turn a, in the frame of its end: var_x = sigma_distance^2 |d|,
    var_y = sigma_lateral^2 |d|, var_theta = sigma_heading_rad_per_sqrt_m^2 |d| + sigma_heading_rad_per_sqrt_rad^2 |a|.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    sigma_distance_m_per_sqrt_m: Sigma = 0.01
    sigma_lateral_m_per_sqrt_m: Sigma = 0.002
    sigma_heading_rad_per_sqrt_m: Sigma = math.radians(0.6)
    sigma_heading_rad_per_sqrt_rad: Sigma = 0.02
    sigma_corner_px: Sigma = 0.2
    # For tag positions that come without a covariance: generous, since they carry the bias of a planar pose (percents
    # of the range for a small frontal tag) and whatever their stamps are late.
    sigma_range_m: Sigma = 0.05
    sigma_range_per_m: Sigma = 0.03  # adds in quadrature: share of the range
    sigma_bearing_rad: Sigma = math.radians(1.0)
    sigma_stamp_s: Sigma = 0.01  # of each stamp by itself: what a detector's queue or a slow loop makes of it


def read_noise_yaml(path: Path) -> NoiseParameters:
    """The parameters in a YAML file; those it leaves out keep their defaults.

    Raises:
        CalibError: one line that names file, field, value, limit and way out.
    """
    return validate(NoiseParameters, parse_mapping(read_text(path), str(path)), str(path))
