"""The tag observations of one log, gathered from its messages.

They are kept as bare numbers: as messages they take ten times the memory, which a small file can hold much of. A map
takes much the same time for each observation, and a file made for it holds fifty times as many as a recorded one of its
size. Such a log is not refused: every second look is used, or third, and what a dense drive loses are looks between
looks.
"""

from array import array
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.tags import Detections, Positions, TagKey
from groundsbot.onboard.detection import REFINED_CORNERS
from groundsbot.onboard.log import TagDetections, TagObservations


class CollectedTags(NamedTuple):
    """What the looks that are used read.

    Attributes:
        tags: sorted.
        pictures_ns: (F,) stamps of pictures, rising, also of those that show no tag.
        detections: in pixels.
        positions: in metres.
        every: one look of so many is used.
        corners_refined: those of all detections were sharpened on the picture.
    """

    tags: tuple[TagKey, ...]
    pictures_ns: IntArray
    detections: Detections
    positions: Positions
    every: int
    corners_refined: bool


# Observations with corrected bits are the ones that turn out to be phantoms.
MAX_HAMMING: Final = 0
# All that the families we know have together: 587 + 35 + 30. Time and memory grow with powers of it: a file of a few
# kilobytes with a thousand tags took over 400 MiB.
_MOST_TAGS: Final = 652
# An observation that was measured takes twelve bytes at least: noise cannot be compressed.
_FREE_OBSERVATIONS: Final = 60_000
_LEAST_BYTES_A_OBSERVATION: Final = 10
# What is used of them: all that a robot could have recorded. A recorded observation takes 200 bytes and more, one of an
# import of millimetres and tenths of a milliradian, ten to a look, 20 with what lies around it.
_FREE_TO_USE: Final = 8000
_BYTES_TO_USE: Final = 12


class TagMessages:
    """Fills from messages, one after the other."""

    def __init__(self) -> None:
        """Empty."""
        self._numbers: dict[TagKey, int] = {}  # in order of their first observation
        self._pictures_ns = array("q")
        self._detected = array("q")  # stamp, tag
        self._corners_px = array("d")
        self._as_detected = False  # some corners, as a library had them
        self._placed = array("q")  # stamp, tag, polar, in camera
        self._places = array("d")  # value, covariance

    @property
    def count(self) -> int:
        """Observations so far."""
        return len(self._detected) // 2 + len(self._placed) // 4

    @property
    def in_pixels(self) -> bool:
        """Whether there are any that need a camera to be read."""
        return bool(self._detected)

    def add_detections(self, message: TagDetections) -> None:
        """Takes one picture's, but for those with corrected bits."""
        self._pictures_ns.append(message.stamp_ns)
        for each in message.detections:
            if each.hamming <= MAX_HAMMING and len(each.corners_px) == 8:
                self._detected.extend((message.stamp_ns, self._number(each.family, each.tag_id)))
                self._corners_px.extend(each.corners_px)
                self._as_detected |= REFINED_CORNERS not in message.detector_settings

    def add_observations(self, message: TagObservations) -> None:
        """Takes one look's."""
        in_camera = message.frame == "camera_planar"
        for each in message.observations:
            polar = each.WhichOneof("position") == "polar"
            number = self._number(each.family, each.tag_id)
            self._placed.extend((message.stamp_ns, number, polar, in_camera))
            place = (each.polar.range_m, each.polar.bearing_rad) if polar else (each.cartesian.x_m, each.cartesian.y_m)
            covariance = each.covariance if len(each.covariance) == 4 else (np.nan,) * 4
            self._places.extend((*place, *covariance))

    def check(self, log: Path, log_bytes: int, n_logs: int = 1) -> None:
        """Refuses more observations and tags than a log can hold that shares what is free with others.

        Raises:
            OfflineError: naming the log, what it has, the limit and the way out.
        """
        most = _FREE_OBSERVATIONS // n_logs + log_bytes // _LEAST_BYTES_A_OBSERVATION
        if self.count > most:
            raise OfflineError(
                f"{log}: more than {most} tag observations, the limit for a log of {log_bytes} bytes: a tag that was "
                "measured takes more room; was this file made for a test? leave out some of the looks"
            )

    def check_tags(self, log: Path) -> None:
        """Refuses more tags than there are.

        Raises:
            OfflineError: naming the log, how many there are, and the limit.
        """
        if len(self._numbers) > _MOST_TAGS:
            raise OfflineError(
                f"{log}: {len(self._numbers)} different tags, limit {_MOST_TAGS} (as many as all families have); "
                "are their numbers right?"
            )

    def collect(self, log_bytes: int, n_logs: int = 1) -> CollectedTags:
        """Those of all looks, or of as many as one of so many logs is worth with this size, evenly spread."""
        tags = tuple(sorted(self._numbers))
        rank = np.empty(len(tags), dtype=np.int64)
        rank[[self._numbers[key] for key in tags]] = np.arange(len(tags))
        detected = np.array(self._detected, dtype=np.int64).reshape(-1, 2)
        placed = np.array(self._placed, dtype=np.int64).reshape(-1, 4)
        places = np.array(self._places).reshape(-1, 6)
        detections = Detections(detected[:, 0], rank[detected[:, 1]], np.array(self._corners_px).reshape(-1, 4, 2))
        positions = Positions(
            stamps_ns=placed[:, 0],
            tag=rank[placed[:, 1]],
            value=places[:, :2],
            polar=placed[:, 2] > 0,
            covariance=places[:, 2:].reshape(-1, 2, 2),
            in_camera=placed[:, 3] > 0,
        )
        pictures_ns = np.unique(np.array(self._pictures_ns, dtype=np.int64))
        every = max(1, -(-self.count // (_FREE_TO_USE // n_logs + log_bytes // _BYTES_TO_USE)))
        if every > 1:
            used_ns = np.union1d(pictures_ns, positions.stamps_ns)[::every]
            pictures_ns = np.intersect1d(pictures_ns, used_ns)
            detections = detections.where(np.isin(detections.stamps_ns, used_ns))
            positions = positions.where(np.isin(positions.stamps_ns, used_ns))
        corners_refined = self.in_pixels and not self._as_detected
        return CollectedTags(tags, pictures_ns, detections, positions, every, corners_refined)

    def _number(self, family: str, tag_id: int) -> int:
        key = TagKey(family, tag_id)
        return self._numbers.setdefault(key, len(self._numbers))
