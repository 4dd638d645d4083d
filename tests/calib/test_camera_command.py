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
from groundsbot.fixtures.pictures.board_picture import BoardPainter, View, drawn_views
from groundsbot.fixtures.pictures.textures import ByteArray
from tests.support.board_cases import FISHEYE, NARROW, WIDE
from tests.support.programs import Run


def pictures(
    camera: CameraModel, count: int, seed: int = 0, flipped: bool = False,
    change: Callable[[View], View] = lambda view: view,
) -> list[ByteArray]:  # fmt: skip
    rng = np.random.default_rng(seed)
    painter = BoardPainter(camera, DEFAULT_BOARD, flipped=flipped)
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


def test_of_many_views_the_most_telling_are_used(good: Good, calib: Run, tmp_path: Path) -> None:
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


BadCase = Callable[[Good, Path], list[object]]


def bad_missing(good: Good, folder: Path) -> list[object]:
    return [folder / "nowhere"]


def bad_empty(good: Good, folder: Path) -> list[object]:
    (folder / "empty").mkdir()
    return [folder / "empty"]


def bad_text(good: Good, folder: Path) -> list[object]:
    (folder / "a.png").write_text("no picture")
    return [folder / "a.png"]


def bad_cut_short(good: Good, folder: Path) -> list[object]:
    encoded = cv2.imencode(".jpg", good.pictures[0])[1].tobytes()
    (folder / "a.jpg").write_bytes(encoded[: len(encoded) // 2])
    return [folder / "a.jpg"]


def bad_no_board(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", [np.full((480, 640), 90, np.uint8)] * 2)]


def bad_one_view(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", good.pictures[:1])]


def bad_alike(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", [good.pictures[0], good.pictures[1]] * 5)]


def bad_dictionary(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--board", "7x9-25mm-18mm-4x4_100"]


def bad_layout(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--board", "6x8-25mm-18mm-5x5_100"]


def bad_marker_size(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--board", "7x9-25mm-26mm-5x5_100"]


def bad_sizes(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", [*good.pictures[:3], cv2.resize(good.pictures[3], (320, 240))])]  # type: ignore[list-item]


def bad_flipped(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", pictures(WIDE, 2, flipped=True))]


def bad_ruler(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--ruler-mm", "97"]


def bad_stretched(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--ruler-mm", "100,97"]


def bad_ruler_words(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--ruler-mm", "about 100"]


def bad_ruler_inches(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--ruler-mm", "3.94"]


def bad_video(good: Good, folder: Path) -> list[object]:
    (folder / "a.mp4").write_bytes(b"\0" * 1000)
    return [folder / "a.mp4"]


def bad_tiny(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", [np.zeros((60, 80), np.uint8)])]


def facing(view: View) -> View:
    """The board parallel to the picture, its middle where it was."""
    middle = np.array([0.0875, 0.1125, 0.0])
    T = np.eye(4)
    T[:3, 3] = view.T_camera_board[:3, :3] @ middle + view.T_camera_board[:3, 3] - middle
    return replace(view, T_camera_board=T)


def bad_frontal(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", pictures(NARROW, 6, change=facing)), "--model", "plumb_bob"]


def bad_blurred(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", pictures(WIDE, 5, change=lambda view: replace(view, defocus_px=8.0)))]


def bad_two_cameras(good: Good, folder: Path) -> list[object]:
    return [save(folder / "p", [*good.pictures[:5], *pictures(NARROW, 5)]), "--model", "plumb_bob"]


def bad_model(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--model", "pinhole"]


def bad_board_word(good: Good, folder: Path) -> list[object]:
    return [good.folder, "--board", "A4"]


BAD: list[tuple[BadCase, list[str]]] = [
    (bad_missing, ["nowhere", "does not exist"]),
    (bad_empty, ["empty", "no PNG or JPEG"]),
    (bad_text, ["a.png", "neither PNG nor JPEG"]),
    (bad_cut_short, ["a.jpg", "cut short"]),
    (bad_no_board, ["2 pictures", "nor any markers"]),
    (bad_one_view, ["1 picture only", "at least 5"]),
    (bad_alike, ["only 2 of 10 views differ", "move the board"]),
    (bad_dictionary, ["5x5_1000", "another board"]),
    (bad_layout, ["another board", "--board"]),
    (bad_marker_size, ["26 mm", "0.9 of the square"]),
    (bad_sizes, ["320x240", "640x480", "one size"]),
    (bad_flipped, ["mirror", "print it again"]),
    (bad_ruler, ["-3.0 %", "tags", "100 %"]),
    (bad_stretched, ["stretched", "-3.0 % down"]),
    (bad_ruler_words, ["'about 100'", "mm"]),
    (bad_ruler_inches, ["3.94", "give mm"]),
    (bad_video, ["a.mp4", "not a readable video"]),
    (bad_tiny, ["80x60", "at least 100"]),
    (bad_frontal, ["focal length", "tilt the board"]),
    (bad_blurred, ["5 pictures", "hold it still"]),
    (bad_two_cameras, ["one camera"]),
    (bad_model, ["'pinhole'", "plumb_bob"]),
    (bad_board_word, ["'a4'", "7x9-25mm-18mm-5x5_100"]),
]


@pytest.mark.parametrize(("case", "words"), BAD, ids=[case.__name__ for case, _ in BAD])
def test_a_bad_input_gives_one_line_in_words_and_nothing_is_written(
    good: Good, calib: Run, tmp_path: Path, case: BadCase, words: list[str]
) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    outcome = calib("camera", *case(good, tmp_path / "in"), "-o", tmp_path / "out" / "camera.yaml")
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


def test_a_camera_that_was_changed_fits_no_more_and_it_is_said_where(good: Good, calib: Run, tmp_path: Path) -> None:
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


def test_a_fisheye_is_recognised_and_calibrated(calib: Run, tmp_path: Path) -> None:
    output = tmp_path / "camera.yaml"
    outcome = calib("camera", save(tmp_path / "p", pictures(FISHEYE, 7)), "-o", output)
    assert outcome.code == 0, outcome.err
    model, estimate = read_camera_yaml(output), read_estimate(output)
    assert model.distortion_model == "equidistant"
    assert estimate is not None
    assert rms_px(difference_px(model, PictureGrid.of(FISHEYE))) < 3.0 * estimate.expected_error_px < 0.1
