"""Tag detector with one corner order and OpenCV's pixel convention for all detector libraries."""

import ctypes
import importlib
import importlib.metadata
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.tags import tag_bits
from groundsbot.onboard.detection.corner_refinement import refine_corners
from groundsbot.onboard.errors import OnboardError

# Part of the detector settings if corners are refined; ",lens" follows if the lens distortion is known.
REFINED_CORNERS: Final = "corners=sides"
SMALLEST_SIDE_PX: Final = 32  # the libraries crash on empty and tiny pictures
_MODULES: Final = {"pupil-apriltags": "pupil_apriltags", "pyapriltags": "pyapriltags"}
_FAMILIES: Final = ("tag36h11", "tag25h9", "tag16h5")
# In the libraries (0, 0) is the corner of the first pixel, in OpenCV its centre.
_PIXEL_CENTRE_PX: Final = 0.5
# Detectors are reused and never freed, see _cached_detector.
_KEPT: dict[tuple[str, str, float, int], Any] = {}


class Detection(NamedTuple):
    """One tag in one picture.

    `corners_px` is [4, 2] in raw (distorted) pixels, with pixel centres at whole numbers. The corners lie on the outer
    edge of the black border, in the order top left, top right, bottom right, bottom left of AprilTag's upright picture.
    """

    family: str
    tag_id: int
    hamming: int
    decision_margin: float
    corners_px: FloatArray


class TagDetector:
    """Detector of the tags of given families. It is not thread-safe.

    Attributes:
        library: name and version of the library in use.
        settings: settings, as text for the log.
    """

    def __init__(
        self,
        families: Sequence[str] = ("tag36h11",),
        library: str = "pupil-apriltags",
        quad_decimate: float = 2.0,
        threads: int = 1,
        *,
        camera: CameraModel | None = None,
        refine: bool = True,
    ) -> None:
        """Load the library.

        Args:
            families: some of "tag36h11", "tag25h9", "tag16h5".
            library: "pupil-apriltags" or "pyapriltags"; the other one is used if this is not installed.
            quad_decimate: factor by which pictures are reduced for the search. 2 is about eight times as fast as 1 and
                misses tags smaller than about 27 px.
            threads: number of threads of the library.
            camera: camera of the pictures, whose distortion bends the sides of tags; None if it is not known.
            refine: refine corners on the picture (`groundsbot.onboard.detection.corner_refinement`).

        Raises:
            OnboardError: neither library is installed, or a family or the library is unknown.
        """
        unknown = [family for family in families if family not in _FAMILIES]
        if unknown or not families:
            raise OnboardError(f"recorder.families: {unknown or 'none'} cannot be detected; use {', '.join(_FAMILIES)}")
        name = _detector_class(library)
        self.library = f"{name} {importlib.metadata.version(name)}"
        corners = "corners=library" if not refine else REFINED_CORNERS if camera is None else f"{REFINED_CORNERS},lens"
        self.settings = f"families={','.join(families)} quad_decimate={quad_decimate:g} threads={threads} {corners}"
        self._camera, self._refine = camera, refine
        # One detector per family: given several, pupil-apriltags detects the first only.
        self._detectors = [(family, _cached_detector(name, family, quad_decimate, threads)) for family in families]

    def detect(self, grey: NDArray[np.uint8]) -> list[Detection]:
        """Return the tags in a grey picture [height, width], sorted by family and id; none if it is too small.

        Raises:
            OnboardError: the picture is not a two-dimensional array of bytes.
        """
        if grey.ndim != 2 or grey.dtype != np.uint8:
            raise OnboardError(f"picture of shape {grey.shape} and type {grey.dtype}: must be grey, one byte a pixel")
        if min(grey.shape) < SMALLEST_SIDE_PX:
            return []
        found = [
            Detection(
                family, int(each.tag_id), int(each.hamming), float(each.decision_margin), _our_corners(each.corners)
            )
            for family, detector in self._detectors
            for each in detector.detect(grey)
        ]
        if self._refine:
            found = self._refine_all(grey, found)
        return sorted(found, key=lambda each: (each.family, each.tag_id, *each.corners_px[0]))

    def _refine_all(self, grey: NDArray[np.uint8], found: list[Detection]) -> list[Detection]:
        """Return the detections with refined corners; a tag whose sides cannot be fitted keeps its corners."""
        camera = self._camera
        if camera is not None and grey.shape != (camera.height_px, camera.width_px):
            camera = None
        cells = np.array([len(tag_bits(each.family, each.tag_id)) for each in found], dtype=np.int64)
        corners_px, _ = refine_corners(grey, np.array([each.corners_px for each in found]), cells, camera)
        return [each._replace(corners_px=corners) for each, corners in zip(found, corners_px, strict=True)]


def _our_corners(corners: FloatArray) -> FloatArray:
    """Return corners in this project's order; both libraries start at the bottom left and go counter-clockwise."""
    return np.array(corners[::-1], dtype=np.float64) - _PIXEL_CENTRE_PX


def _detector_class(wanted: str) -> str:
    if wanted not in _MODULES:
        raise OnboardError(f"recorder.detector: {wanted!r} is unknown; use {' or '.join(_MODULES)}")
    for name in (wanted, *_MODULES):
        try:
            importlib.import_module(_MODULES[name])
        except ImportError:
            continue
        return name
    raise OnboardError(f"no tag detector is installed: pip install {wanted} (pyapriltags on ARM)")


def _cached_detector(name: str, family: str, quad_decimate: float, threads: int) -> Any:  # noqa: ANN401 - untyped library
    key = (name, family, quad_decimate, threads)
    if key not in _KEPT:
        module = importlib.import_module(_MODULES[name])
        detector = module.Detector(families=family, nthreads=threads, quad_decimate=quad_decimate)
        # pupil-apriltags frees the families before the detector that uses them, which corrupts the heap. An extra
        # reference prevents freeing, also at the end of the interpreter.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(detector))
        _KEPT[key] = detector
    return _KEPT[key]
