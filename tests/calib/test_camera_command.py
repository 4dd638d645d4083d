"""`groundsbot-calib camera` and `check` as a person meets them: good pictures, and all that can be wrong with them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.camera.file import read_camera_yaml, read_estimate, write_camera_yaml
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.intrinsics.projection_uncertainty import PictureGrid, difference_px, rms_px
from groundsbot.fixtures.pictures.board_picture import View, drawn_views
from groundsbot.fixtures.pictures.textures import ByteArray
from tests.support.board_cases import FISHEYE, NARROW, WIDE, painter_of
from tests.support.programs import Run


def pictures(
    camera: CameraModel, count: int, seed: int = 0, flipped: bool = False,
    change: Callable[[View], View] = lambda view: view,
) -> list[ByteArray]:  # fmt: skip
    rng = np.random.default_rng(seed)
    painter = painter_of(camera, flipped)
    views = drawn_views(camera, DEFAULT_BOARD, count, rng)
    return [painter.picture(change(view), rng) for view in views]


def save(folder: Path, shown: list[ByteArray]) -> Path:
    folder.mkdir(exist_ok=True)
    for picture in shown:
        assert cv2.imwrite(str(folder / f"{len(list(folder.iterdir())):03d}.png"), picture)
    return folder


@dataclass(frozen=True)
class Good:
    pictures: list[ByteArray]
    folder: Path
    camera: Path
    said: str


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Good:
    """Pictures by a camera of 90 degrees, one of them blurred, and what is calibrated from them."""
    from groundsbot.calib.intrinsics.command import calibrate_camera

    folder = tmp_path_factory.mktemp("good")
    shown = pictures(WIDE, 10)
    blurred = pictures(WIDE, 1, 3, change=lambda view: replace(view, defocus_px=1.0))
    save(folder / "pictures", [*shown, *blurred])
    output = folder / "calibrated" / "camera.yaml"
    output.parent.mkdir()
    said = calibrate_camera([folder / "pictures"], output, None, "auto", "100", "front", 60, False)
    return Good(shown, folder / "pictures", output, "\n".join(said))


def test_a_camera_file_a_page_and_sentences_come_of_good_pictures(good: Good) -> None:
    model, estimate = read_camera_yaml(good.camera), read_estimate(good.camera)
    assert (model.name, model.distortion_model) == ("front", "plumb_bob")
    assert estimate is not None
    assert rms_px(difference_px(model, PictureGrid.of(WIDE))) < 3.0 * estimate.expected_error_px < 0.1
    assert "010.png: left out, too blurred" in good.said
    assert "that is good: below 0.1 px everywhere" in good.said
    assert "to improve it further, take the board farther away" in good.said
    page = good.camera.with_suffix(".html").read_text()
    assert "http" not in page.replace("https://www.w3.org", "")
    assert "010.png" in page
    assert "front" in page
    assert sorted(each.name for each in good.camera.parent.iterdir()) == ["camera.html", "camera.yaml"]


def test_of_many_views_the_most_informative_are_used(good: Good, calib: Run, tmp_path: Path) -> None:
    output = tmp_path / "camera.yaml"
    outcome = calib("camera", good.folder, "-o", output, "--model", "plumb_bob", "--most-views", "7")
    assert outcome.code == 0, outcome.err
    assert f"used; look at {tmp_path / 'camera.html'}" in outcome.out
    estimate = read_estimate(output)
    assert estimate is not None
    assert estimate.n_views <= 7
    assert rms_px(difference_px(read_camera_yaml(output), PictureGrid.of(WIDE))) < 0.1


def test_a_video_is_as_good_as_pictures(good: Good, calib: Run, tmp_path: Path) -> None:
    video = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (640, 480), isColor=False)
    for picture in good.pictures[:6]:
        for _ in range(2):
            writer.write(picture)
    writer.release()
    outcome = calib("camera", video, "-o", tmp_path / "camera.yaml", "--model", "plumb_bob")
    assert outcome.code == 0, outcome.err
    assert rms_px(difference_px(read_camera_yaml(tmp_path / "camera.yaml"), PictureGrid.of(WIDE))) < 0.3


def cut_short(good: Good, folder: Path) -> list[object]:
    encoded = cv2.imencode(".jpg", good.pictures[0])[1].tobytes()
    (folder / "a.jpg").write_bytes(encoded[: len(encoded) // 2])
    return [folder / "a.jpg"]


def file_of(name: str, content: bytes) -> Callable[[Good, Path], list[object]]:
    def make(_good: Good, folder: Path) -> list[object]:
        (folder / name).write_bytes(content)
        return [folder / name]

    return make


def facing(view: View) -> View:
    """The board parallel to the picture, its middle where it was."""
    middle = np.array([0.0875, 0.1125, 0.0])
    T = np.eye(4)
    T[:3, 3] = view.T_camera_board[:3, :3] @ middle + view.T_camera_board[:3, 3] - middle
    return replace(view, T_camera_board=T)


def blurred(view: View) -> View:
    return replace(view, defocus_px=8.0)


def smaller(picture: ByteArray) -> ByteArray:
    return np.asarray(cv2.resize(picture, (320, 240)), np.uint8)


EMPTY_WALL = np.full((480, 640), 90, np.uint8)
# By case: what is given besides the output, and words of what is said.
BAD: dict[str, tuple[Callable[[Good, Path], list[object]], list[str]]] = {
    "missing": (lambda good, folder: [folder / "nowhere"], ["nowhere", "does not exist"]),
    "empty": (lambda good, folder: [save(folder / "empty", [])], ["empty", "no PNG or JPEG"]),
    "text": (file_of("a.png", b"no picture"), ["a.png", "neither PNG nor JPEG"]),
    "cut short": (cut_short, ["a.jpg", "truncated"]),
    "no board": (lambda good, folder: [save(folder / "p", [EMPTY_WALL] * 2)], ["2 pictures", "nor any markers"]),
    "one view": (lambda good, folder: [save(folder / "p", good.pictures[:1])], ["1 of 1 picture only", "at least 5"]),
    "alike": (lambda good, folder: [save(folder / "p", good.pictures[:2] * 5)], ["only 2 of 10 views differ", "move"]),
    "dictionary": (lambda good, _: [good.folder, "--board", "7x9-25mm-18mm-4x4_100"], ["5x5_1000", "another board"]),
    "layout": (lambda good, _: [good.folder, "--board", "6x8-25mm-18mm-5x5_100"], ["another board", "--board"]),
    "marker": (lambda good, _: [good.folder, "--board", "7x9-25mm-26mm-5x5_100"], ["26 mm", "0.9 of the square"]),
    "board": (lambda good, _: [good.folder, "--board", "A4"], ["'a4'", "7x9-25mm-18mm-5x5_100"]),
    "sizes": (
        lambda good, folder: [save(folder / "p", [*good.pictures[:3], smaller(good.pictures[3])])],
        ["320x240", "640x480", "one size"],
    ),
    "flipped": (lambda _, folder: [save(folder / "p", pictures(WIDE, 2, flipped=True))], ["mirror", "print it again"]),
    "ruler": (lambda good, _: [good.folder, "--ruler-mm", "97"], ["-3.0 %", "tags", "100 %"]),
    "stretched": (lambda good, _: [good.folder, "--ruler-mm", "100,97"], ["stretched", "-3.0 % down"]),
    "ruler in words": (lambda good, _: [good.folder, "--ruler-mm", "about 100"], ["'about 100'", "mm"]),
    "ruler in inches": (lambda good, _: [good.folder, "--ruler-mm", "3.94"], ["3.94", "give mm"]),
    "video": (file_of("a.mp4", bytes(1000)), ["a.mp4", "not a readable video"]),
    "tiny": (lambda _, folder: [save(folder / "p", [EMPTY_WALL[:60, :80]])], ["80x60", "at least 100"]),
    "frontal": (
        lambda _, folder: [save(folder / "p", pictures(NARROW, 6, change=facing)), "--model", "plumb_bob"],
        ["focal length", "tilt the board"],
    ),
    "blurred": (
        lambda _, folder: [save(folder / "p", pictures(WIDE, 5, change=blurred))],
        ["5 pictures", "hold it still"],
    ),
    "two cameras": (
        lambda good, folder: [
            save(folder / "p", [*good.pictures[:5], *pictures(NARROW, 5)]), "--model", "plumb_bob",
        ],
        ["one camera"],
    ),
    "model": (lambda good, _: [good.folder, "--model", "pinhole"], ["'pinhole'", "plumb_bob"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_input_gives_one_line_in_words_and_nothing_is_written(
    good: Good, calib: Run, tmp_path: Path, case: str
) -> None:
    arguments, words = BAD[case]
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    outcome = calib("camera", *arguments(good, tmp_path / "in"), "-o", tmp_path / "out" / "camera.yaml")
    assert outcome.code == 1
    assert outcome.out == ""
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1
    for word in words:
        assert word.lower() in outcome.err.lower()
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "words"), [("nowhere/camera.yaml", ["folder"]), ("camera.html", [".yaml"]), ("old.yaml", ["--overwrite"])]
)
def test_an_output_that_cannot_be_is_refused_before_any_work(
    good: Good, calib: Run, tmp_path: Path, name: str, words: list[str]
) -> None:
    (tmp_path / "old.yaml").write_text("mine")
    outcome = calib("camera", good.folder, "-o", tmp_path / name)
    assert outcome.code == 1
    for word in words:
        assert word in outcome.err
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("old.yaml", "mine")]


def test_a_camera_goes_on_fitting_pictures_it_took_later(good: Good, calib: Run, tmp_path: Path) -> None:
    outcome = calib("check", good.camera, save(tmp_path / "p", pictures(WIDE, 6, seed=5)))
    assert outcome.code == 0, outcome.out
    assert outcome.out.startswith("fits")


def test_a_changed_camera_does_not_fit_and_the_place_is_reported(good: Good, calib: Run, tmp_path: Path) -> None:
    refocused = replace(WIDE, fx_px=1.006 * WIDE.fx_px, fy_px=1.006 * WIDE.fy_px)
    outcome = calib("check", good.camera, save(tmp_path / "p", pictures(refocused, 6, seed=5)))
    assert outcome.code == 3
    assert "does not fit any more" in outcome.out
    assert "the most at the" in outcome.out
    difference = rms_px(difference_px(WIDE, PictureGrid.of(refocused)))
    told = float(outcome.out.split("differ by ")[1].split(" px")[0])
    assert told == pytest.approx(difference, rel=0.1)


def test_a_file_that_says_nothing_of_its_errors_may_be_off_by_what_does_not_matter(
    good: Good, calib: Run, tmp_path: Path
) -> None:
    write_camera_yaml(replace(WIDE, fx_px=WIDE.fx_px + 0.15, fy_px=WIDE.fy_px + 0.15), tmp_path / "other.yaml")
    outcome = calib("check", tmp_path / "other.yaml", good.folder)
    assert outcome.code == 0, outcome.out
    assert "the difference is significant" in outcome.out


def test_check_refuses_pictures_of_another_size(good: Good, calib: Run, tmp_path: Path) -> None:
    write_camera_yaml(WIDE.resize(2.0), tmp_path / "large.yaml")
    outcome = calib("check", tmp_path / "large.yaml", good.folder)
    assert outcome.code == 1
    assert "640x480" in outcome.err
    assert "1280x960" in outcome.err


def test_check_cannot_decide_from_pictures_that_do_not_determine_the_camera(calib: Run, tmp_path: Path) -> None:
    write_camera_yaml(NARROW, tmp_path / "camera.yaml")
    outcome = calib("check", tmp_path / "camera.yaml", save(tmp_path / "p", pictures(NARROW, 6, change=facing)))
    assert outcome.code == 1
    assert "tilt the board" in outcome.err


def test_a_fisheye_is_recognised_and_calibrated(calib: Run, tmp_path: Path) -> None:
    output = tmp_path / "camera.yaml"
    outcome = calib("camera", save(tmp_path / "p", pictures(FISHEYE, 7)), "-o", output)
    assert outcome.code == 0, outcome.err
    model, estimate = read_camera_yaml(output), read_estimate(output)
    assert model.distortion_model == "equidistant"
    assert estimate is not None
    assert rms_px(difference_px(model, PictureGrid.of(FISHEYE))) < 3.0 * estimate.expected_error_px < 0.1
