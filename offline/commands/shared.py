"""Functions of several commands: the robots' files, the output folder, and lines for the terminal."""

from collections.abc import Sequence
from pathlib import Path

from groundsbot.calib.foundation import echo
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.maps import ScaleBudget
from groundsbot.offline.measurements import RobotFile, read_robot_file


def read_robot_files(paths: Sequence[Path]) -> dict[str, RobotFile]:
    """Read robot files by robot id, which must be unique."""
    robot_files: dict[str, RobotFile] = {}
    for path in paths:
        given = read_robot_file(path)
        if given.robot.robot_id in robot_files:
            raise OfflineError(
                f"--robot {path}: another --robot file has the same robot_id {given.robot.robot_id!r}; give one file "
                "for each robot"
            )
        robot_files[given.robot.robot_id] = given
    return robot_files


def echo_line(text: str) -> None:
    """Write a line to stderr."""
    echo(text, err=True)


def scale_line(metre: ScaleBudget, *, several: bool) -> str:
    """Return what determines the scale."""
    of = f" of component {metre.component + 1}" if several else ""
    shares = sorted(((share, kind) for kind, share in metre.shares.items() if share >= 0.005), reverse=True)
    held = ", ".join(f"{kind} {100.0 * share:.0f} %" for share, kind in shares)
    return f"scale{of}: known to {100.0 * metre.sigma:.2f} %, determined by {held}"


def check_output(output: Path, inputs: Sequence[Path], own_file: str, *, overwrite: bool) -> None:
    """Refuse an output folder in which something could be lost.

    Args:
        output: a folder.
        inputs: logs and maps, which must not be changed.
        own_file: file that marks a folder as replaceable.
        overwrite: whether to replace such a folder.

    Raises:
        OfflineError: one line that says what is in the way.
    """
    if output.exists() and not output.is_dir():
        raise OfflineError(f"-o {output}: is a file; name a folder that is empty or not there yet")
    for path in inputs:
        if output.resolve() in (path.resolve(), *path.resolve().parents) or path.resolve() in output.resolve().parents:
            raise OfflineError(
                f"-o {output}: holds {path} or lies in it; name another folder, so that inputs are not changed"
            )
    if not output.is_dir() or not any(output.iterdir()):
        return
    if not overwrite:
        raise OfflineError(f"-o {output}: the folder is not empty; name another one, or give --overwrite")
    if not (output / own_file).is_file():
        raise OfflineError(
            f"-o {output}: --overwrite replaces what was written before, and there is no {own_file} in it; name "
            "another folder"
        )
