"""The program groundsbot-calib: printing and camera calibration. Commands import heavy packages when they run."""

from pathlib import Path
from typing import Annotated

import typer

from groundsbot.calib.foundation import EXIT_WITH_LOSSES, echo, new_app, run

app = new_app("Print calibration boards and tags, calibrate a camera, and check whether a calibration still fits.")

PdfOption = Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="The PDF to write.")]
PaperOption = Annotated[str, typer.Option(help="a4, letter or a3.")]
OverwriteFlag = Annotated[bool, typer.Option("--overwrite", help="Replace FILE if it exists.")]


@app.command()
def board(
    output: PdfOption,
    paper: PaperOption = "a4",
    columns: Annotated[int, typer.Option(help="Squares across.")] = 7,
    rows: Annotated[int, typer.Option(help="Squares down.")] = 9,
    square_mm: Annotated[float, typer.Option(help="Side of a square.")] = 25.0,
    marker_mm: Annotated[float | None, typer.Option(help="Side of a marker. [default: 0.72 of the square]")] = None,
    dictionary: Annotated[
        str, typer.Option(help="Marker dictionary: cells by cells, and its size, as 5x5_100.")
    ] = "5x5_100",
    overwrite: OverwriteFlag = False,
) -> None:
    """Write a calibration board (ChArUco) as a PDF true to scale, with rulers to check the print.

    The default board fits on A4 and on Letter, and `groundsbot-calib camera` expects it. For any other board, give
    that command the word that is printed on the sheet as --board.
    """
    from groundsbot.calib.board import MARKER_SHARE, CharucoBoard
    from groundsbot.calib.printing import print_board

    side_mm = MARKER_SHARE * square_mm if marker_mm is None else marker_mm
    made = CharucoBoard(columns, rows, square_mm, side_mm, dictionary)
    print_board(made, paper, output, overwrite)
    echo(f"{output}: board {made.specification}; print it at 100 % and check its rulers")


@app.command()
def tags(
    output: PdfOption,
    ids: Annotated[str, typer.Option(help="Ids and ranges, as 0-23,40.")],
    size_mm: Annotated[float, typer.Option(help="Side of the black border's outer edge.")],
    family: Annotated[str, typer.Option(help="tag36h11, tag25h9 or tag16h5.")] = "tag36h11",
    paper: PaperOption = "a4",
    packed: Annotated[
        bool, typer.Option("--packed", help="Put as many tags on a sheet as fit, instead of one.")
    ] = False,
    overwrite: OverwriteFlag = False,
) -> None:
    """Write tags as a PDF true to scale, with id, size, an arrow that points up, cutting marks and rulers.

    The size of a tag is the side of its black border's outer edge. The white margin belongs to the tag: cut outside of
    it.
    """
    from groundsbot.calib.foundation import plural
    from groundsbot.calib.printing import print_tags
    from groundsbot.calib.tags import parse_tag_ids

    wanted = parse_tag_ids(ids, family)
    n_sheets = print_tags(family, wanted, size_mm, paper, output, packed, overwrite)
    echo(f"{output}: {plural(len(wanted), 'tag')} {family} of {size_mm:g} mm on {plural(n_sheets, 'sheet')}")
    echo("print at 100 %, check the rulers; in robot.yaml:")
    echo(f"tags: [{{family: {family}, default_size_m: {size_mm / 1e3:g}}}]")


PicturesArgument = Annotated[
    list[Path], typer.Argument(metavar="PICTURES|VIDEO...", help="Files, folders of pictures, or videos.")
]
BoardOption = Annotated[
    str | None,
    typer.Option(
        "--board",
        metavar="WORD",
        help="The board, as printed on it, or as 11x8-30mm-22mm-4x4_50-legacy, chessboard-9x6-25mm, "
        "aprilgrid-6x6-88mm-0.3. [default: that of `board`]",
    ),
]


@app.command()
def camera(
    pictures: PicturesArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="The camera file to write.")],
    board: BoardOption = None,
    model: Annotated[
        str,
        typer.Option(
            help="plumb_bob, rational_polynomial, equidistant (fisheye), or auto: the one that predicts best."
        ),
    ] = "auto",
    ruler_mm: Annotated[
        str | None,
        typer.Option(metavar="MM[,MM]", help="Measured length of the printed 100 mm: across, and down."),
    ] = None,
    name: Annotated[str, typer.Option(help="The camera's name in the file.")] = "camera",
    most_views: Annotated[
        int, typer.Option(help="Maximum number of views; of more, the most informative are used.", min=5)
    ] = 60,
    overwrite: OverwriteFlag = False,
) -> None:
    """Calibrate a camera from pictures of the board. Writes ROS camera_info with sigmas, and a report.

    The report lies beside FILE as .html. It shows the expected prediction error over the picture, the views, their
    residuals, and which views are missing.
    """
    from groundsbot.calib.intrinsics import calibrate_camera

    for line in calibrate_camera(pictures, output, board, model, ruler_mm, name, most_views, overwrite):
        echo(line)


@app.command()
def check(
    camera: Annotated[Path, typer.Argument(metavar="CAMERA", help="The camera file: ROS camera_info or Kalibr.")],
    pictures: PicturesArgument,
    board: BoardOption = None,
) -> None:
    """Check whether a calibration still fits its camera: calibrate again from pictures of the board and compare.

    Exit code 0: it fits; 3: it does not fit any more.
    """
    from groundsbot.calib.intrinsics import check_camera

    result = check_camera(camera, pictures, board)
    for line in result.lines:
        echo(line)
    if not result.fits:
        raise typer.Exit(EXIT_WITH_LOSSES)


def main() -> None:
    """Run the program."""
    run(app)


if __name__ == "__main__":
    main()
