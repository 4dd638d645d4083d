"""A gyro on a drive with known truth, for `tests.benchmarks.accuracy.cramer_rao`: its noise and how its turns depend on
its scale and its bias.

It measures the rate less a share (the scale) plus its bias, in white noise. The bias is a random walk: unknown at
nodes, and linear between them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray

# What the walk between two nodes adds to a turn between them is at most this share of the sigma that white noise adds.
_WALK_SHARE: Final = 0.1


@dataclass(frozen=True)
class GyroNoise:
    """Sigmas of its white noise, of the walk of its bias, and of its bias at the start and its scale; 0: known."""

    noise_rad_per_sqrt_s: float
    bias_walk_rad_s_per_sqrt_s: float
    bias_rad_s: float
    scale: float


@dataclass(frozen=True)
class TrueGyro:
    """A gyro in one run.

    Attributes:
        noise: of it.
        time_s: [N] of the run's moments.
        is_known: [N - 1] whether it measured all the time from each moment to the next.
    """

    noise: GyroNoise
    time_s: FloatArray
    is_known: BoolArray

    @cached_property
    def node_s(self) -> FloatArray:
        """[n] times of the nodes of the bias; one where it does not walk.

        The integral of a walk that is held at both ends of T has the variance walk^2 T^3 / 12, white noise noise^2 T.
        """
        walk, first_s, last_s = self.noise.bias_walk_rad_s_per_sqrt_s, self.time_s[0], self.time_s[-1]
        if walk == 0.0 or last_s == first_s:
            return self.time_s[:1]
        longest_s = _WALK_SHARE * 12.0**0.5 * self.noise.noise_rad_per_sqrt_s / walk
        return np.linspace(first_s, last_s, 1 + int(np.ceil((last_s - first_s) / longest_s)))

    @property
    def sigma(self) -> FloatArray:
        """[1 + n] priors of the scale and of the bias at each node; 0: known, infinite: no prior of its own."""
        return np.array([self.noise.scale, self.noise.bias_rad_s, *[np.inf] * (len(self.node_s) - 1)])

    @property
    def turn_variance(self) -> FloatArray:
        """[N - 1] of the turn from each moment to the next."""
        return np.asarray(self.noise.noise_rad_per_sqrt_s**2 * np.diff(self.time_s))

    def turn_jacobian(self, turn_rad: FloatArray) -> FloatArray:
        """[N - 1, 1 + n] of turns by scale and bias: what is measured, less the bias, is to be raised by the scale."""
        middle_s = 0.5 * (self.time_s[1:] + self.time_s[:-1])
        by_bias = [-np.diff(self.time_s) * np.interp(middle_s, self.node_s, hat) for hat in np.eye(len(self.node_s))]
        return np.column_stack([turn_rad, *by_bias])

    def walk_information(self) -> FloatArray:
        """[1 + n, 1 + n] of the differences from node to node."""
        rows = np.diff(np.eye(len(self.node_s)), axis=0)
        sigma = self.noise.bias_walk_rad_s_per_sqrt_s * np.sqrt(np.diff(self.node_s))
        return np.pad(rows.T @ (rows / sigma[:, None] ** 2), ((1, 0), (1, 0)))
