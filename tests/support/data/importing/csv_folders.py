"""CSV folders to import, and what the logs made of them hold."""

from pathlib import Path

from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.importing.run_writer import ImportReport
from groundsbot.onboard.log.messages import PlanarOdometry, RunInfo, TagObservations
from groundsbot.onboard.log.reading.reader import read_log

TRACK = ImportOptions(track_width_m=0.5)
PAPER = ImportOptions(track_width_m=0.508, state_rate_hz=4.2)
ODOMETRY = "t_s,left_m_s,right_m_s\n0,0,0\n1,1,1\n2,0.5,1\n"
OBSERVATIONS = "t_s,tag_id,x_m,y_m\n0.5,7,3,1\n1.5,7,2,1\n1.5,9,4,-1\n"


def folder_with(tmp_path: Path, files: dict[str, str], name: str = "drive") -> Path:
    folder = tmp_path / name
    folder.mkdir()
    for file, text in files.items():
        (folder / file).write_text(text)
    return folder


def import_run(
    tmp_path: Path, odometry: str = ODOMETRY, observations: str = OBSERVATIONS, options: ImportOptions = TRACK
) -> ImportReport:
    folder = folder_with(tmp_path, {"odometry.csv": odometry, "observations.csv": observations})
    return import_folder(folder, tmp_path / "logs", options)


def odometry_of(log: Path) -> list[PlanarOdometry]:
    return [entry.message for entry in read_log(log) if isinstance(entry.message, PlanarOdometry)]


def observations_of(log: Path) -> list[TagObservations]:
    return [entry.message for entry in read_log(log) if isinstance(entry.message, TagObservations)]


def run_of(log: Path) -> RunInfo:
    first = next(iter(read_log(log))).message
    assert isinstance(first, RunInfo)
    return first
