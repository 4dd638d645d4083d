"""Tags of a run: their identity, detections in pixels, and imported positions in metres."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray


class TagKey(NamedTuple):
    """The identity of a tag.

    Attributes:
        family: as named by the detector.
        tag_id: number within the family.
        instance: distinguishes tags that share an id; empty where the id is unique.
    """

    family: str
    tag_id: int
    instance: str = ""

    @property
    def whole(self) -> "TagKey":
        """The key without the instance."""
        return TagKey(self.family, self.tag_id)


@dataclass(frozen=True)
class Detections:
    """M tag detections in pixels.

    Attributes:
        stamps_ns: (M,) middle of the picture's exposure.
        tag: (M,) index into `Run.tags`.
        corners_px: (M, 4, 2) raw pixels, corner order of groundsbot.proto.
        camera: (M,) index into `Robot.camera_names`.
    """

    stamps_ns: IntArray
    tag: IntArray
    corners_px: FloatArray
    camera: IntArray

    def where(self, which: BoolArray) -> "Detections":
        """Return the selected detections."""
        return Detections(self.stamps_ns[which], self.tag[which], self.corners_px[which], self.camera[which])


@dataclass(frozen=True)
class Positions:
    """M imported tag positions in metres.

    Attributes:
        stamps_ns: (M,)
        tag: (M,) index into `Run.tags`.
        value: (M, 2) (x, y) or (range, bearing).
        polar: (M,) whether the value is (range, bearing).
        covariance: (M, 2, 2) of the value, NaN where the log has none.
        in_camera: (M,) whether the value is in the camera's planar frame (x forward, y left), not in base.
    """

    stamps_ns: IntArray
    tag: IntArray
    value: FloatArray
    polar: BoolArray
    covariance: FloatArray
    in_camera: BoolArray

    def where(self, which: BoolArray) -> "Positions":
        """Return the selected positions."""
        return Positions(*(getattr(self, each.name)[which] for each in fields(self)))


def concatenate_detections(parts: Sequence[Detections]) -> Detections:
    """Return all detections in one, in their order."""
    return Detections(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Detections)))
