"""How far off detected corners are, in rendered pictures whose corners are known.

    python -m tests.benchmarks.accuracy.corner_error_study --pictures 100

One tag a picture, in front of a wall, at another place among the pixels each time. From a plain case (40 px of side,
seen at 20 degrees, sharp, still, lit evenly) one thing is changed at a time. Detectors: both AprilTag libraries,
looking at all pixels (/1) and at half as many each way (/2, as on the robot), and OpenCV's ArUco detector with its own
refinement for AprilTags. After each: its corners as they are, cv2.cornerSubPix on them, and
`groundsbot.onboard.detection.corner_refinement` without and with the lens.

A cell is RMSE / bias in hundredths of a pixel and coordinate: the bias is the mean along the tag's diagonals, outward
positive, which is what light that spreads does to a tag. Under it the spread of what is left. A last table has the
processor time of a refinement.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.camera_section import Mount
from groundsbot.fixtures.drives.calibration import true_tag_sizes_m
from groundsbot.fixtures.drives.true_motion import TrueMotion
from groundsbot.fixtures.pictures.render import Renderer
from groundsbot.fixtures.pictures.visibility import CameraView
from groundsbot.fixtures.recording.session import Options, prepare
from groundsbot.fixtures.worlds.scene import Tags, faces_of, tags_of
from groundsbot.fixtures.worlds.world import Pictures, Wall, World, WorldTag, load_world
from groundsbot.onboard.detection.corner_refinement import refine_corners
from groundsbot.onboard.detection.tag_detector import TagDetector
from tests.benchmarks.command_line import say

Grey = NDArray[np.uint8]
Detect = Callable[[Grey], FloatArray | None]

FOCAL_PX: Final = 900.0
SIDE_M: Final = 0.15
TAG_ID: Final = 17
CELLS: Final = 8
_NS: Final = 1_000_000_000
_FARTHEST_PX: Final = 3.0  # beyond, something else was detected


@dataclass(frozen=True)
class Case:
    """What a tag looks like in the picture."""

    name: str
    side_px: float = 40.0
    angle_deg: float = 20.0
    smear_px: float = 0.0  # of motion during the exposure
    wall: float = 0.6  # brightness of the wall behind the tag
    lit: float = 0.0  # share by which light grows from the tag's left side to its right
    off_axis_px: float = 0.0  # that the picture is cut out of a larger one, down and right of the lens's axis
    settings: dict[str, float] = field(default_factory=dict)  # of groundsbot.fixtures.worlds.world.Pictures


CASES: Final = (
    Case("plain"),
    *(Case(f"side {side} px", side_px=side) for side in (16.0, 20.0, 28.0, 80.0, 160.0)),
    *(Case(f"angle {angle} deg", angle_deg=angle) for angle in (0.0, 45.0, 60.0, 70.0)),
    *(Case(f"defocus {blur} px", settings={"defocus_px": blur}) for blur in (0.3, 1.0, 1.6)),
    *(Case(f"smear {smear} px", smear_px=smear) for smear in (1.0, 3.0)),
    Case("gamma 1.1", settings={"gamma": 1.1}),
    Case("overexposed, blooming", settings={"white": 1.3, "bloom": 0.3}),
    Case("dim", wall=0.15, settings={"white": 0.2, "black": 0.012, "full_well_electrons": 3000.0}),
    Case("lit from one side", lit=0.1),
    Case("off the lens's axis", off_axis_px=400.0),
    Case("the same, side 160 px", side_px=160.0, off_axis_px=400.0),
)


@dataclass
class Errors:
    """What one detector and refinement made of one case: (n, 4, 2) px each, in the tag's own directions."""

    found: list[FloatArray] = field(default_factory=list)  # errors along x, y
    outward: list[FloatArray] = field(default_factory=list)  # (4,) along the diagonal
    n_pictures: int = 0

    def add(self, corners_px: FloatArray | None, true_px: FloatArray) -> None:
        """One picture's corners; None: not detected."""
        self.n_pictures += 1
        if corners_px is None:
            return
        error = corners_px - true_px
        away = true_px - true_px.mean(axis=0)
        self.found.append(error)
        self.outward.append((error * away).sum(axis=1) / np.linalg.norm(away, axis=1))

    @property
    def rmse_px(self) -> float:
        """Of a coordinate."""
        return float(np.sqrt(np.mean(np.square(self.found)))) if self.found else float("nan")

    @property
    def bias_px(self) -> float:
        """Mean outward."""
        return float(np.mean(self.outward)) if self.outward else float("nan")

    def cell(self) -> str:
        """As the table has it."""
        return f"{100 * self.rmse_px:6.1f} /{100 * self.bias_px:6.1f}" if self.found else f"{'-':>14}"


def pictures_of(case: Case, n: int, seed: int = 0) -> tuple[CameraModel, list[tuple[Grey, FloatArray]]]:
    """The camera, and n pictures with the true corners (4, 2)."""
    settings = Pictures().model_copy(update=case.settings)
    camera = _camera(case)
    eye = CameraView(camera, Mount(z_m=0.4).T_base_camera.as_matrix(), 0.0, settings.exposure_s)
    ray = camera.unproject(np.array([camera.width_px / 2.0, camera.height_px / 2.0]))
    towards = eye.T_base_camera[:3, :3] @ ray
    world = _world(case, towards)
    tags = tags_of(world.tags, np.array([SIDE_M]))
    renderer = Renderer(settings, world.ceiling_height_m, tags, faces_of(world), eye)
    rng = np.random.default_rng(seed)
    taken = []
    for _ in range(n):
        drive = _drive(case, rng, settings.exposure_s)
        taken.append((_lit(renderer.picture(drive, _NS // 2, rng), case), _true_corners(tags, eye, drive)))
    return camera, taken


def _lit(grey: Grey, case: Case) -> Grey:
    """With the light of a lamp to the right."""
    if not case.lit:
        return grey
    off_middle_px = np.arange(grey.shape[1]) - 0.5 * (grey.shape[1] - 1)
    light = (1.0 + case.lit / case.side_px * off_middle_px) / (1.0 + 0.5 * case.lit / case.side_px * grey.shape[1])
    lit: Grey = np.rint(grey * light).astype(np.uint8)
    return lit


def _camera(case: Case) -> CameraModel:
    size = round(1.5 * case.side_px + 70.0)
    middle = 0.5 * size - case.off_axis_px
    return CameraModel("c", size, size, FOCAL_PX, FOCAL_PX, middle, middle, "plumb_bob", (-0.18, 0.07, 0.0, 0.0, 0.0))


def _world(case: Case, towards: FloatArray) -> World:
    """The tag in the middle of the picture, upright, on a wall of its own."""
    distance_m = FOCAL_PX * SIDE_M / case.side_px
    place = np.array([0.0, 0.0, 0.4]) + distance_m * towards / np.linalg.norm(towards)
    yaw = np.degrees(np.arctan2(-towards[1], -towards[0])) + case.angle_deg
    normal = np.array([np.cos(np.radians(yaw)), np.sin(np.radians(yaw))])
    along = np.array([-normal[1], normal[0]])
    on_wall = place[:2] - 0.002 * normal
    line_m = [(on_wall - 4.0 * along).tolist(), (on_wall + 4.0 * along).tolist()]
    wall = Wall(line_m=line_m, brightness=case.wall)
    tag = WorldTag(tag_id=TAG_ID, position_m=place.tolist(), yaw_deg=float(yaw), size_m=SIDE_M, roll_deg=4.0)
    up_to_m = max(4.0, float(place[2]) + 3.0)
    update: dict[str, Any] = {"walls": [wall], "boxes": [], "tags": [tag], "ceiling_height_m": up_to_m}
    return load_world("room").model_copy(update=update)


def _drive(case: Case, rng: np.random.Generator, exposure_s: float) -> TrueMotion:
    """A robot that stands, or turns so fast that the picture smears, near the origin."""
    turn_rad_s = case.smear_px / (FOCAL_PX * exposure_s)
    pose = rng.uniform(-1.0, 1.0, 3) * [0.02, 0.02, 4.0 / FOCAL_PX]
    half = np.array([0.0, 0.0, 0.5 * turn_rad_s])
    stamps_ns: FloatArray = np.array([0, _NS])
    none = np.zeros(2)
    return TrueMotion(stamps_ns.astype(np.int64), np.stack([pose - half, pose + half]), none, none)


def _true_corners(tags: Tags, eye: CameraView, drive: TrueMotion) -> FloatArray:
    rotation, place = eye.world_poses(drive.at(np.array(_NS // 2, dtype=np.int64)))
    return eye.model.project((tags.corners_m[0] - place) @ rotation)


def detectors() -> dict[str, Detect]:
    """By name."""
    found: dict[str, Detect] = {}
    for library in ("pupil-apriltags", "pyapriltags"):
        for decimate in (1.0, 2.0):
            detector = TagDetector(["tag36h11"], library, decimate, refine=False)
            if detector.library.startswith(library):  # else the other one stands in for it
                found[f"{library} /{decimate:g}"] = partial(_of_tag, detector)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11), parameters)
    found["aruco"] = lambda grey: _of_aruco(aruco, grey)
    return found


def _of_tag(detector: TagDetector, grey: Grey) -> FloatArray | None:
    return next((each.corners_px for each in detector.detect(grey) if each.tag_id == TAG_ID), None)


def _of_aruco(detector: Any, grey: Grey) -> FloatArray | None:
    corners, ids, _ = detector.detectMarkers(grey)
    if ids is None or TAG_ID not in ids.ravel():
        return None
    found = corners[list(ids.ravel()).index(TAG_ID)].reshape(4, 2)
    return np.asarray(found, dtype=np.float64) - 0.5  # it has this refinement's half pixel from AprilTag's library


def refinements(camera: CameraModel) -> dict[str, Callable[[Grey, FloatArray], FloatArray]]:
    """By name."""
    cells = np.array([CELLS])
    return {
        "as detected": lambda _, corners: corners,
        "cornerSubPix": _sub_pix,
        "sides": lambda grey, corners: refine_corners(grey, corners[None], cells)[0][0],
        "sides, lens": lambda grey, corners: refine_corners(grey, corners[None], cells, camera)[0][0],
    }


def _sub_pix(grey: Grey, corners_px: FloatArray) -> FloatArray:
    """Looks as far as the next thing printed lets it: a cell, at most 5 px."""
    shortest = float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).min())
    window = int(np.clip(round(shortest / CELLS), 2, 5))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    found = cv2.cornerSubPix(
        grey, corners_px.astype(np.float32).reshape(-1, 1, 2), (window, window), (-1, -1), criteria
    )
    return np.asarray(found.reshape(4, 2), dtype=np.float64)


def in_order(corners_px: FloatArray, true_px: FloatArray) -> FloatArray | None:
    """Turned so that they fit: OpenCV's dictionary is turned against AprilTag's. None where they are not the tag's."""
    turned = min(
        (np.roll(corners_px, k, axis=0) for k in range(4)), key=lambda each: float(np.abs(each - true_px).sum())
    )
    return turned if np.abs(turned - true_px).max() < _FARTHEST_PX else None


def study_case(case: Case, n: int) -> dict[tuple[str, str], Errors]:
    """Errors by detector and refinement."""
    camera, taken = pictures_of(case, n)
    refine = refinements(camera)
    errors: dict[tuple[str, str], Errors] = {}
    for detector, detect in detectors().items():
        for grey, true_px in taken:
            raw = detect(grey)
            corners = None if raw is None else in_order(raw, true_px)
            for refinement, function in refine.items():
                sharper = None if corners is None else function(grey, corners)
                errors.setdefault((detector, refinement), Errors()).add(sharper, true_px)
    return errors


def study_drives(world: World, seed: int, every: int) -> dict[str, Errors]:
    """Errors by refinement in one of so many pictures of a world's drives, detected as its robots do."""
    tags = tags_of(world.tags, true_tag_sizes_m(world, seed, False))
    errors: dict[str, Errors] = {}
    for robot in world.robots:
        session = prepare(world, robot, tags, Options(seed))
        eye, camera, recorder = session.eye, session.camera, session.nominal.recorder
        assert eye is not None
        assert camera is not None
        renderer = Renderer(world.pictures, world.ceiling_height_m, session.tags, session.faces, eye)
        detector = TagDetector(recorder.families, recorder.detector, recorder.quad_decimate, refine=False)
        refine, rng = refinements(camera), session.stream("pictures of the study")
        for taken in session.pictures()[::every]:
            grey = renderer.picture(session.drive, taken.middle_ns, rng)
            rotation, place = eye.world_poses(session.drive.at(np.array(taken.middle_ns, dtype=np.int64)))
            for found in detector.detect(grey):
                (index,) = np.flatnonzero(tags.tag_id == found.tag_id)
                true_px = camera.project((tags.corners_m[index] - place) @ rotation)
                detected = in_order(found.corners_px, true_px)
                for way, function in refine.items():
                    sharper = None if detected is None else function(grey, detected)
                    errors.setdefault(way, Errors()).add(sharper, true_px)
    return errors


def refinement_ms(n_tags: int, repeats: int = 20) -> dict[str, float]:
    """Processor time for a picture with so many tags."""
    case = replace(CASES[0], side_px=60.0)
    camera, ((grey, true_px),) = pictures_of(case, 1)
    many, cells = np.repeat(true_px[None], n_tags, axis=0), np.full(n_tags, CELLS)
    ways: dict[str, Callable[[], object]] = {
        "cornerSubPix": lambda: [_sub_pix(grey, each) for each in many],
        "sides": lambda: refine_corners(grey, many, cells),
        "sides, lens": lambda: refine_corners(grey, many, cells, camera),
    }
    found = {}
    for name, way in ways.items():
        way()
        began = time.process_time()
        for _ in range(repeats):
            way()
        found[name] = 1e3 * (time.process_time() - began) / repeats
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=int, default=100, help="of each case [100]")
    parser.add_argument("--cases", default="", help="only those whose name begins so")
    parser.add_argument("--world", default="nsh", help="also in pictures of its drives [nsh]")
    parser.add_argument("--every", type=int, default=20, help="one of so many of these, none for 0 [20]")
    given = parser.parse_args(arguments)
    ways = list(refinements(_camera(CASES[0])))
    say(f"{'case':24s} {'detector':20s} {'found':>6s} " + " ".join(f"{way:>14s}" for way in ways))
    for case in CASES:
        if not case.name.startswith(given.cases):
            continue
        errors = study_case(case, given.pictures)
        for detector in dict.fromkeys(detector for detector, _ in errors):
            of_detector = [errors[detector, way] for way in ways]
            found = len(of_detector[0].found) / of_detector[0].n_pictures
            cells = " ".join(each.cell() for each in of_detector)
            say(f"{case.name:24s} {detector:20s} {found:6.0%} {cells}")
    if given.every:
        of_drives = study_drives(load_world(given.world), 0, given.every)
        n = len(of_drives[ways[0]].found)
        say(
            f"{given.world + ', seed 0':24s} {f'{n} tags':20s} {'':6s} "
            + " ".join(of_drives[way].cell() for way in ways)
        )
    for n_tags in (1, 6):
        told = ", ".join(f"{name} {ms:.2f} ms" for name, ms in refinement_ms(n_tags).items())
        say(f"processor time a picture of {n_tags} tags of 60 px: {told}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
