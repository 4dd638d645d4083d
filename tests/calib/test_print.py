"""Printed tags and rulers, scanned: the robot's detector finds each tag at its id, the right way up, at its size."""

import sys
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.printing.sheet import PAPERS_MM
from groundsbot.calib.tags.family import families, family_size, tag_bits
from groundsbot.onboard.detection.tag_detector import TagDetector
from tests.support.programs import Run
from tests.support.scanned_prints import n_pages, ruler_ticks_mm, scan_page, words

DPI = 150.0
RULER_DPI = 300.0
CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])  # of an upright tag, in its size
LETTERS_MM = 5.0  # a detector of tag16h5 sees tags in letters too


def tags_on(pdf: Path, family: str, page: int) -> list[tuple[int, FloatArray]]:
    """Ids and corners `[4, 2]` of the tags on a sheet, in mm from the paper's upper left corner, in reading order."""
    scan = scan_page(pdf, DPI, page)
    found = [
        (each.tag_id, scan.place_mm(each.corners_px))
        for each in TagDetector([family], quad_decimate=1.0).detect(scan.picture)
        if each.hamming == 0
    ]
    large = [(tag_id, corners) for tag_id, corners in found if np.ptp(corners[:, 0]) > LETTERS_MM]
    return sorted(large, key=lambda each: (round(each[1][0, 1]), each[1][0, 0]))


@pytest.mark.parametrize("family", families())
@pytest.mark.parametrize(("size_mm", "paper"), [(20.0, "a4"), (33.3, "letter"), (100.0, "a3")])
def test_packed_tags_are_read_back_at_id_orientation_and_size(
    calib: Run, tmp_path: Path, family: str, size_mm: float, paper: str
) -> None:
    pdf, last = tmp_path / "tags.pdf", family_size(family) - 1
    options = ["--family", family, "--ids", f"{last},0-8", "--size-mm", size_mm, "--paper", paper]
    done = calib("tags", *options, "--packed", "-o", pdf)
    assert (done.code, done.err) == (0, "")
    assert f"10 tags {family} of {size_mm:g} mm on {n_pages(pdf)} sheet" in done.out
    assert f"tags: [{{family: {family}, default_size_m: {size_mm / 1000:g}}}]" in done.out
    sheets = [tags_on(pdf, family, page) for page in range(n_pages(pdf))]
    assert [tag_id for sheet in sheets for tag_id, _ in sheet] == [last, *range(9)]
    paper_mm = size_mm * (1.0 + 2.0 / len(tag_bits(family, 0)))  # with the white margin
    for page, sheet in enumerate(sheets):
        said = words(pdf, page)
        assert f"Tags {family}, {size_mm:g} mm, sheet {page + 1} of {len(sheets)}" in said
        assert f"{size_mm:g} mm is the outer edge of the black border" in said
        for tag_id, corners in sheet:
            np.testing.assert_allclose(corners - corners.mean(axis=0), CORNERS * size_mm, atol=0.1)
            assert f"up {family} id {tag_id} {size_mm:g} mm" in said
        centres = np.array([corners.mean(axis=0) for _, corners in sheet])
        apart = np.abs(centres[:, np.newaxis] - centres).max(axis=-1)[~np.eye(len(sheet), dtype=np.bool_)]
        assert (apart > paper_mm).all()


def test_without_packing_each_tag_has_a_sheet_and_its_white_margin(calib: Run, tmp_path: Path) -> None:
    pdf = tmp_path / "tags.pdf"
    done = calib("tags", "--ids", "17,4", "--size-mm", "150", "-o", pdf)
    assert done.code == 0
    assert n_pages(pdf) == 2
    for page, tag_id in enumerate((17, 4)):
        ((found, corners),) = tags_on(pdf, "tag36h11", page)
        assert found == tag_id
        np.testing.assert_allclose(corners - corners.mean(axis=0), CORNERS * 150.0, atol=0.1)
        scan = scan_page(pdf, DPI, page)
        cell_mm, bleed_mm = 150.0 / 8, 0.3
        (top, left), (inner_top, inner_left) = (scan.pixel(*(corners[0] - d)) for d in (cell_mm, bleed_mm))
        (bottom, right), (inner_bottom, inner_right) = (scan.pixel(*(corners[2] + d)) for d in (cell_mm, bleed_mm))
        picture = scan.picture.copy()
        picture[inner_top:inner_bottom, inner_left:inner_right] = 255
        assert (picture[top:bottom, left:right] == 255).all()


def test_cutting_marks_stand_around_the_white_margin_and_name(calib: Run, tmp_path: Path) -> None:
    pdf = tmp_path / "tags.pdf"
    calib("tags", "--ids", "0", "--size-mm", "80", "-o", pdf)
    ((_, corners),) = tags_on(pdf, "tag36h11", 0)
    scan = scan_page(pdf, RULER_DPI)

    def dark(x_mm: float, y_mm: float) -> bool:
        row, column = scan.pixel(x_mm, y_mm)
        return bool(scan.picture[row - 1 : row + 2, column - 1 : column + 2].min() < 128)

    (left, top), (right, bottom) = corners[0] - 10.0, corners[2] + 10.0
    bottom += 6.0  # the strip with the name
    for x_mm, outwards_x in ((left, -1.0), (right, 1.0)):
        for y_mm, outwards_y in ((top, -1.0), (bottom, 1.0)):
            assert dark(x_mm + 1.5 * outwards_x, y_mm)
            assert dark(x_mm, y_mm + 1.5 * outwards_y)
            assert not dark(x_mm - 0.5 * outwards_x, y_mm)  # nothing left of them on what is cut out
            assert not dark(x_mm, y_mm - 0.5 * outwards_y)


@pytest.mark.parametrize(
    ("command", "paper"),
    [(("board",), "a4"), *((("tags", "--ids", "0", "--size-mm", "50"), paper) for paper in PAPERS_MM)],
)
def test_the_rulers_ticks_are_a_millimetre_apart(
    calib: Run, tmp_path: Path, command: tuple[str, ...], paper: str
) -> None:
    pdf = tmp_path / "page.pdf"
    assert calib(*command, "--paper", paper, "-o", pdf).code == 0
    scan = scan_page(pdf, RULER_DPI)
    width_mm, height_mm = PAPERS_MM[paper]
    np.testing.assert_allclose(scan.pixel_mm * scan.picture.shape[::-1], [width_mm, height_mm], atol=1e-4)
    for ticks_mm, longest_mm in zip(ruler_ticks_mm(scan), (height_mm, width_mm), strict=True):
        assert longest_mm - 30.0 < len(ticks_mm) < longest_mm
        np.testing.assert_allclose(np.diff(ticks_mm), 1.0, atol=0.05)
        assert np.ptp(ticks_mm) == pytest.approx(len(ticks_mm) - 1, abs=0.05)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["tags", "--ids", "0", "--size-mm", "153"], "at most 152 fits on a4 with the white margin of tag36h11"),
        (["tags", "--ids", "0", "--size-mm", "143", "--family", "tag16h5"], "at most 142 fits on a4"),
        (["tags", "--ids", "0", "--size-mm", "158", "--paper", "letter"], "at most 157 fits on letter"),
        (["tags", "--ids", "0", "--size-mm", "300", "--packed"], "at most 152 fits on a4"),
        (["tags", "--ids", "0", "--size-mm", "0.15"], "0.15 but must be at least 20"),
        (["tags", "--ids", "0", "--size-mm", "-80"], "-80 but must be at least 20"),
        (["tags", "--ids", "0", "--size-mm", "nan"], "nan but must be at least 20"),
        (["tags", "--ids", "0", "--size-mm", "inf"], "inf but at most 152"),
        (["tags", "--ids", "580-587", "--size-mm", "80"], "names 587 but tag36h11 has the ids 0 to 586"),
        (["tags", "--ids", "0-99999999999999", "--size-mm", "80"], "names 99999999999999 but"),
        (["tags", "--ids", "5-3", "--size-mm", "80"], "'5-3', which ends before it begins; write 3-5"),
        (["tags", "--ids", "0-4,3", "--size-mm", "80"], "names 3 twice"),
        (["tags", "--ids", "1,,2", "--size-mm", "80"], "must read like 0-23,40; '' is neither"),
        (["tags", "--ids", "one", "--size-mm", "80"], "'one' is neither id nor range"),
        (["tags", "--ids", "0", "--size-mm", "80", "--family", "tag36h10"], "'tag36h10' but must be one of tag36h11"),
        (["tags", "--ids", "0", "--size-mm", "80", "--paper", "a5"], "'a5' but must be one of a4, letter, a3"),
        (["board", "--square-mm", "30"], "does not fit on a4 beside its rulers; take squares of 27"),
        (["board", "--square-mm", "-25"], "must be above 0"),
        (["board", "--square-mm", "inf"], "does not fit on a4"),
        (["board", "--square-mm", "nan"], "must be above 0"),
        (["board", "--columns", "2"], "at least 3x3"),
        (["board", "--marker-mm", "24"], "at most 0.9 of the square"),
        (["board", "--dictionary", "apriltag"], "'apriltag' but must be one of 4x4_50"),
        (["board", "--columns", "40", "--rows", "50", "--square-mm", "4"], "takes 1000 markers but 5x5_100 has 100"),
        (["board", "--paper", "napkin"], "'napkin' but must be one of a4"),
    ],
)
def test_what_cannot_be_printed_is_one_line_and_nothing_written(
    calib: Run, tmp_path: Path, command: list[str], said: str
) -> None:
    done = calib(*command, "-o", tmp_path / "page.pdf")
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith("error: ")
    assert done.err.count("\n") == 1
    assert said in done.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", [["board"], ["tags", "--ids", "0", "--size-mm", "80"]], ids=["board", "tags"])
def test_a_file_that_is_there_stays_unless_it_may_be_replaced(calib: Run, tmp_path: Path, command: list[str]) -> None:
    there = tmp_path / "robot.yaml"
    there.write_text("mine")
    refused = calib(*command, "-o", there)
    assert (refused.code, there.read_text()) == (1, "mine")
    assert "robot.yaml: exists already; name another file, or give --overwrite" in refused.err
    assert calib(*command, "-o", there, "--overwrite").code == 0
    assert there.read_bytes().startswith(b"%PDF")
    nowhere = calib(*command, "-o", tmp_path / "gone" / "page.pdf")
    assert nowhere.code == 1
    assert "cannot be written (No such file or directory)" in nowhere.err
    folder = calib(*command, "-o", tmp_path, "--overwrite")
    assert folder.code == 1
    assert folder.err.count("\n") == 1
    assert [each.name for each in tmp_path.iterdir()] == ["robot.yaml"]


def test_the_same_tags_make_the_same_file(calib: Run, tmp_path: Path) -> None:
    for name in ("a.pdf", "b.pdf"):
        calib("tags", "--ids", "0-3", "--size-mm", "50", "-o", tmp_path / name)
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


@pytest.mark.parametrize("command", [["board"], ["tags", "--ids", "0", "--size-mm", "80"]], ids=["board", "tags"])
def test_a_robot_without_the_printing_library_says_so(
    calib: Run, tmp_path: Path, command: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (
        "groundsbot.calib.printing",
        "groundsbot.calib.printing.sheet",
        "groundsbot.calib.printing.board",
        "groundsbot.calib.printing.tags",
    ):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, "reportlab.lib.units", None)
    done = calib(*command, "-o", tmp_path / "page.pdf")
    assert (done.code, done.out) == (1, "")
    assert done.err == ("error: printing needs reportlab, which is not installed; pip install 'groundsbot[laptop]'\n")
