"""The `import` command: recordings in, a run's log of each out; all of them, or none."""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

from groundsbot.offline.commands.progress_bar import progress_bar
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, possible_workers, worker_processes
from groundsbot.offline.importing import (
    BagOptions,
    ImportOptions,
    ImportReport,
    WpilogOptions,
    check_output,
    import_bag,
    import_folder,
    import_wpilog,
    is_bag,
    is_wpilog,
)


class ImportChoices(NamedTuple):
    """Options of the command line: those of all recordings, and those of bags, some of which are of .wpilog too."""

    options: ImportOptions
    of_bags: BagOptions
    swerve_modules_m: str | None


def import_recordings(
    recordings: Sequence[Path], output: Path, choices: ImportChoices, n_workers: int | None = None
) -> list[ImportReport]:
    """Import each recording as a run in the output folder, and return their reports in order.

    Args:
        recordings: folders of CSV files, bags, or .wpilog files.
        output: folder of runs.
        choices: options, which hold for each recording.
        n_workers: number of processes that share the recordings; None: as many as are of use.

    Raises:
        GroundsbotError: one line that says what is wrong; then no run is left in the folder.
    """
    if len(recordings) == 1:
        with progress_bar() as show:
            return [_import_recording(_Recording(recordings[0], output, choices), Stages(show))]
    if choices.options.run_id is not None:
        raise OfflineError(
            f"--run-id {choices.options.run_id}: names one run, but there are {len(recordings)} recordings; leave it "
            "out, or import them one by one"
        )
    n = min(len(recordings), n_workers or possible_workers())
    with progress_bar() as show, _hidden_folder(output) as hidden, worker_processes(n) as workers:
        items = [_Recording(each, hidden / str(i), choices) for i, each in enumerate(recordings)]
        names = [str(each) for each in recordings]
        reports = workers.map(_import_recording, items, names, Stages(show), "importing recordings")
        return _move_runs(reports, recordings, output)


class _Recording(NamedTuple):
    """A recording, the folder for its run, and how to import it."""

    path: Path
    output: Path
    choices: ImportChoices


def _import_recording(recording: _Recording, stages: Stages) -> ImportReport:
    path, output, (options, of_bags, swerve_modules_m) = recording
    if is_wpilog(path):
        of_bags.refuse_any(path, but=tuple(vars(WpilogOptions())))
        of_logs = WpilogOptions(
            of_bags.odometry_topic, of_bags.tags_topic, of_bags.imu_topic, of_bags.tag_size_m, swerve_modules_m
        )
        return import_wpilog(path, output, options, of_logs)
    if swerve_modules_m is not None:
        raise OfflineError(f"{path}: is not a .wpilog file, so --swerve-modules-m would have no effect; leave it out")
    if is_bag(path):
        return import_bag(path, output, options, of_bags, stages.notify)
    of_bags.refuse_any(path)
    return import_folder(path, output, options)


@contextmanager
def _hidden_folder(output: Path) -> Iterator[Path]:
    """Yield a new hidden folder in the output folder, and remove it in the end, with what is left in it."""
    made = [each for each in (output, *output.parents) if not each.exists()]
    hidden = output / f".import.{uuid4().hex}"  # in containers a killed import had the same process id
    check_output(output, hidden)
    try:
        try:
            hidden.mkdir(parents=True)
        except OSError as error:
            raise OfflineError(f"-o {output}: cannot be written ({error.strerror}); give another folder") from error
        yield hidden
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
        for each in made:
            if each.is_dir() and not any(each.iterdir()):
                each.rmdir()


def _move_runs(reports: Sequence[ImportReport], recordings: Sequence[Path], output: Path) -> list[ImportReport]:
    """Move all runs to the output folder, once it is certain that none is in the way of another.

    Raises:
        GroundsbotError: two recordings would be one run, or a run is there already.
    """
    placed: dict[Path, Path] = {}
    for report, recording in zip(reports, recordings, strict=True):
        run_folder = output / report.run_folder.name
        if run_folder in placed:
            raise OfflineError(
                f"{recording}: would be run {report.run_id}, as {placed[run_folder]} is; import them one by one, with "
                "--run-id"
            )
        placed[run_folder] = recording
        check_output(output, run_folder)
    moved: list[Path] = []
    try:
        for report, run_folder in zip(reports, placed, strict=True):
            report.run_folder.rename(run_folder)
            moved.append(run_folder)
    except BaseException as error:
        for each in moved:
            shutil.rmtree(each, ignore_errors=True)
        if isinstance(error, OSError):
            raise OfflineError(f"-o {output}: cannot be written ({error.strerror}); give another folder") from error
        raise
    return [replace(report, run_folder=run_folder) for report, run_folder in zip(reports, placed, strict=True)]
