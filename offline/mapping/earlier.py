"""What a map of drives under way takes from a map of their earlier parts."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.maps import FittedNoise
from groundsbot.offline.self_calibration import FreedRobots

_NOTHING_FREED: Final = FreedRobots([], (), {}, {}, {}, {})


@dataclass(frozen=True)
class EarlierMap:
    """Noise and calibration that stay, and local maps that initialise those of the longer drives.

    Attributes:
        noise: noise of wheels and tag observations; the default before any fit.
        noise_fit: its fit, with the errors that neighbouring observations share.
        freed: which parameters of robot.yaml were freed, and their corrections; its runs are not used.
        local_maps: local maps of an earlier map under the same noise and calibration, by segment.
    """

    noise: NoiseParameters = field(default_factory=NoiseParameters)
    noise_fit: FittedNoise | None = None
    freed: FreedRobots = _NOTHING_FREED
    local_maps: Mapping[str, LocalMap] = field(default_factory=dict)
