"""What a run saw of tags: which they are, their corners in pixels, and the places that an import has of them."""

from dataclasses import dataclass
from typing import NamedTuple

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray


class TagKey(NamedTuple):
    """What a detector can tell of a tag; and which one it is where an id turned out to hang in several places."""

    family: str
    tag_id: int
    instance: str = ""

    @property
    def whole(self) -> "TagKey":
        """The id alone, whichever instance."""
        return TagKey(self.family, self.tag_id)


@dataclass(frozen=True)
class Detections:
    """M tags in pixels.

    Attributes:
        stamps_ns: (M,) middle of the picture's exposure.
        tag: (M,) index into `Run.tags`.
        corners_px: (M, 4, 2) raw pixels, corner order of groundsbot.proto.
    """

    stamps_ns: IntArray
    tag: IntArray
    corners_px: FloatArray

    def where(self, which: BoolArray) -> "Detections":
        """Some of them."""
        return Detections(self.stamps_ns[which], self.tag[which], self.corners_px[which])


@dataclass(frozen=True)
class Positions:
    """M imported tag positions in metres.

    Attributes:
        stamps_ns: (M,)
        tag: (M,) index into `Run.tags`.
        value: (M, 2) (x, y) or (range, bearing).
        polar: (M,) whether it is the latter.
        covariance: (M, 2, 2) of the value, NaN where the log has none.
        in_camera: (M,) about the camera's place and yaw (x forward, y left) instead of base.
    """

    stamps_ns: IntArray
    tag: IntArray
    value: FloatArray
    polar: BoolArray
    covariance: FloatArray
    in_camera: BoolArray

    def where(self, which: BoolArray) -> "Positions":
        """Some of them."""
        return Positions(
            self.stamps_ns[which],
            self.tag[which],
            self.value[which],
            self.polar[which],
            self.covariance[which],
            self.in_camera[which],
        )
