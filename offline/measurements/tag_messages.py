"""Collects the tag detections and observations of one log from its messages.

They are stored in flat arrays, which take a tenth of the memory of the messages. The time to map a log grows with its
number of observations, and a log that is made to be dense has fifty times as many as a recorded one of its size. Such
a log is accepted, but only every n-th picture of it is used.
"""

from array import array
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.tags import Detections, Positions, TagKey, concatenate_detections
from groundsbot.onboard.detection import REFINED_CORNERS
from groundsbot.onboard.log import TagDetections, TagObservations


class CollectedTags(NamedTuple):
    """The tags of a log, thinned to the pictures that are used.

    Attributes:
        tags: all tags of the log, sorted.
        pictures_ns: (F,) stamps of pictures, including those without tags, increasing for each camera.
        picture_camera: (F,) number of their camera.
        detections: detections in pixels.
        positions: positions in metres.
        every: the sampling interval: one picture in `every` is used.
        corners_refined: whether all corners were refined on the picture.
    """

    tags: tuple[TagKey, ...]
    pictures_ns: IntArray
    picture_camera: IntArray
    detections: Detections
    positions: Positions
    every: int
    corners_refined: bool


# False detections nearly always have corrected bits.
MAX_HAMMING: Final = 0
# The number of tags in all supported families: 587 + 35 + 30. Time and memory grow with powers of it: a file of a few
# kilobytes with a thousand tags took over 400 MiB.
_MOST_TAGS: Final = 652
# A measured observation takes at least twelve bytes, because noise cannot be compressed.
_FREE_OBSERVATIONS: Final = 60_000
_LEAST_BYTES_A_OBSERVATION: Final = 10
# Bounds on the observations that are used; everything that a robot can record stays within them. A recorded observation
# takes 200 bytes or more. One imported with a resolution of 1 mm and 0.1 mrad, ten to a picture, takes 20.
_FREE_TO_USE: Final = 8000
_BYTES_TO_USE: Final = 12


@dataclass
class _CameraTags:
    """Pictures and detections of one camera in flat arrays."""

    pictures_ns: "array[int]" = field(default_factory=lambda: array("q"))
    detected: "array[int]" = field(default_factory=lambda: array("q"))  # stamp, tag
    corners_px: "array[float]" = field(default_factory=lambda: array("d"))

    def forget(self, until_ns: int) -> None:
        """Remove pictures and detections up to a stamp."""
        del self.pictures_ns[: bisect_right(self.pictures_ns, until_ns)]
        n_detected = bisect_right(self.detected[::2], until_ns)
        del self.detected[: 2 * n_detected], self.corners_px[: 8 * n_detected]

    def detections(self, number: int) -> Detections:
        """Return the detections, with tags by number of their first observation, of the camera with this number."""
        rows = np.array(self.detected, dtype=np.int64).reshape(-1, 2)
        return Detections(
            rows[:, 0], rows[:, 1], np.array(self.corners_px).reshape(-1, 4, 2), np.full(len(rows), number)
        )


class TagMessages:
    """Flat arrays of tags, filled message by message."""

    def __init__(self) -> None:
        """Begin without messages."""
        self._numbers: dict[TagKey, int] = {}  # in order of their first observation
        self._cameras: dict[str, _CameraTags] = {}
        self._has_unrefined = False
        self._placed = array("q")  # stamp, tag, polar, in camera
        self._places = array("d")  # value, covariance

    @property
    def count(self) -> int:
        """Number of detections and observations so far."""
        return sum(len(each.detected) for each in self._cameras.values()) // 2 + len(self._placed) // 4

    @property
    def in_pixels(self) -> list[str]:
        """Names of the cameras with detections in pixels, which need a camera model."""
        return [name for name, each in self._cameras.items() if each.detected]

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras with pictures, in order of their first; one empty name for a single camera."""
        return list(self._cameras)

    def add_detections(self, message: TagDetections, camera: str = "") -> None:
        """Add the detections of one picture of a camera, except those with corrected bits."""
        own = self._cameras.setdefault(camera, _CameraTags())
        own.pictures_ns.append(message.stamp_ns)
        for each in message.detections:
            if each.hamming <= MAX_HAMMING and len(each.corners_px) == 8:
                own.detected.extend((message.stamp_ns, self._number(each.family, each.tag_id)))
                own.corners_px.extend(each.corners_px)
                self._has_unrefined |= REFINED_CORNERS not in message.detector_settings

    def add_observations(self, message: TagObservations) -> None:
        """Add the imported observations of one time."""
        in_camera = message.frame == "camera_planar"
        for each in message.observations:
            polar = each.WhichOneof("position") == "polar"
            number = self._number(each.family, each.tag_id)
            self._placed.extend((message.stamp_ns, number, polar, in_camera))
            place = (each.polar.range_m, each.polar.bearing_rad) if polar else (each.cartesian.x_m, each.cartesian.y_m)
            covariance = each.covariance if len(each.covariance) == 4 else (np.nan,) * 4
            self._places.extend((*place, *covariance))

    def forget(self, until_ns: Mapping[str, int]) -> None:
        """Remove pictures, detections and observations up to a stamp; those added before came in order of stamps.

        Args:
            until_ns: the stamp of each camera, by name, the first camera's first; observations have the first's.
        """
        for name, each in self._cameras.items():
            each.forget(until_ns[name])
        n_placed = bisect_right(self._placed[::4], next(iter(until_ns.values())))
        del self._placed[: 4 * n_placed], self._places[: 6 * n_placed]

    def check(self, log: Path, log_bytes: int, n_logs: int = 1) -> None:
        """Refuse more observations than a recorded log of this size can hold.

        Args:
            log: named in the error.
            log_bytes: its size.
            n_logs: number of logs that share the free allowance.

        Raises:
            OfflineError: the limit is exceeded.
        """
        most = _FREE_OBSERVATIONS // n_logs + log_bytes // _LEAST_BYTES_A_OBSERVATION
        if self.count > most:
            raise OfflineError(
                f"{log}: more than {most} tag observations, the limit for a log of {log_bytes} bytes, because a "
                "measured observation takes more bytes; leave out some of the pictures"
            )

    def check_tags(self, log: Path) -> None:
        """Refuse more tags than all families have together.

        Raises:
            OfflineError: the limit is exceeded.
        """
        if len(self._numbers) > _MOST_TAGS:
            raise OfflineError(
                f"{log}: {len(self._numbers)} different tags, limit {_MOST_TAGS} (as many as all families have); "
                "correct the tag ids in it"
            )

    def collect(self, log_bytes: int, n_logs: int = 1, names: Sequence[str] = ("",)) -> CollectedTags:
        """Return all tags, or those of evenly spaced pictures where the log has more than its size allows.

        Args:
            log_bytes: size of the log.
            n_logs: number of logs that share the free allowance.
            names: names of all cameras, in the order of their numbers.
        """
        tags = tuple(sorted(self._numbers))
        rank = np.empty(len(tags), dtype=np.int64)
        rank[[self._numbers[key] for key in tags]] = np.arange(len(tags))
        placed = np.array(self._placed, dtype=np.int64).reshape(-1, 4)
        places = np.array(self._places).reshape(-1, 6)
        positions = Positions(
            stamps_ns=placed[:, 0],
            tag=rank[placed[:, 1]],
            value=places[:, :2],
            polar=placed[:, 2] > 0,
            covariance=places[:, 2:].reshape(-1, 2, 2),
            in_camera=placed[:, 3] > 0,
        )
        every = max(1, -(-self.count // (_FREE_TO_USE // n_logs + log_bytes // _BYTES_TO_USE)))
        pictures: list[IntArray] = []
        found: list[Detections] = []
        used_positions = positions
        for number, name in enumerate(names):
            own = self._cameras.get(name, _CameraTags())
            pictures_ns, detections = np.unique(np.array(own.pictures_ns, dtype=np.int64)), own.detections(number)
            if every > 1:  # for each camera, as those of two may alternate
                used_ns = np.union1d(pictures_ns, positions.stamps_ns)[::every]
                pictures_ns = np.intersect1d(pictures_ns, used_ns)
                detections = detections.where(np.isin(detections.stamps_ns, used_ns))
                if number == 0:
                    used_positions = positions.where(np.isin(positions.stamps_ns, used_ns))
            pictures.append(pictures_ns)
            found.append(replace(detections, tag=rank[detections.tag]))
        return CollectedTags(
            tags=tags,
            pictures_ns=np.concatenate(pictures),
            picture_camera=np.repeat(np.arange(len(names)), [len(each) for each in pictures]),
            detections=concatenate_detections(found),
            positions=used_positions,
            every=every,
            corners_refined=bool(self.in_pixels) and not self._has_unrefined,
        )

    def _number(self, family: str, tag_id: int) -> int:
        key = TagKey(family, tag_id)
        return self._numbers.setdefault(key, len(self._numbers))
