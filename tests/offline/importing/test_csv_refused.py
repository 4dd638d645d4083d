"""CSV folders that cannot become logs are refused in one line, with nothing left behind."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from groundsbot.calib.errors import GroundsbotError
from groundsbot.offline.foundation.csv_table import read_table
from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.onboard.log.messages import PlanarOdometry
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.importing.csv_folders import OBSERVATIONS, ODOMETRY, PAPER, TRACK, folder_with, import_run

BAD_ODOMETRY = [
    ("", "odometry.csv: is empty"),
    ("t_s,left_m_s,right_m_s\n", "has a header but no rows"),
    ("t_s,left,right_m_s\n0,0,0\n", "odometry.csv line 1: column 'left' is unknown"),
    ("t_s,left_m_s\n0,0\n", "column 'right_m_s' is missing beside 'left_m_s'"),
    ("left_m_s,right_m_s\n0,0\n", "needs exactly one of the columns t_s and t_ns"),
    ("t_s,t_ns,left_m_s,right_m_s\n0,0,0,0\n", "needs exactly one of the columns t_s and t_ns"),
    ("t_s,left_m_s,right_m_s,v_m_s,omega_rad_s\n0,0,0,0,0\n", "needs exactly one of these sets"),
    ("t_s,left_m_s,left_m_s,right_m_s\n0,0,0,0\n", "column 'left_m_s' is there twice"),
    ("t_s;left_m_s;right_m_s\n0;0;0\n", "odometry.csv line 1: is separated by ';'; write the file with commas"),
    ("t_s\tleft_m_s\tright_m_s\n0\t0\t0\n", "odometry.csv line 1: is separated by '\\t'; write the file with commas"),
    (
        "0,0,0\n1,0.5,0\n",
        "odometry.csv line 1: holds the number '0' where names of columns belong; add",
    ),
    ("t_s,left_m_s,right_m_s\n0,0,0\n1,0\n", "odometry.csv line 3: has 2 cells, needs 3"),
    ("t_s,left_m_s,right_m_s\n0,0,0\n1,x,0\n", "odometry.csv line 3, column left_m_s: 'x' is not a number"),
    ("t_s,left_m_s,right_m_s\n0,0,0\n1,,0\n", "line 3, column left_m_s: '' is not a number"),
    ("t_s,left_m_s,right_m_s\n0,0,0\n1,0,nan\n", "line 3, column right_m_s: 'nan' is not finite"),
    ("t_s,left_m_s,right_m_s\n0,0,0\n\n1,0,inf\n", "line 4, column right_m_s: 'inf' is not finite"),
    ("t_s,left_m_s,right_m_s\n1,0,0\n0.5,0,0\n", "line 3, column t_s: '0.5' runs backwards after '1'"),
    ("t_s,left_m_s,right_m_s\n1,0,0\n1.0,0,0\n", "line 3, column t_s: '1.0' stands still after '1'"),
    ("t_s,left_m_s,right_m_s\n-1,0,0\n", "column t_s: '-1' is outside 0"),
    ("t_s,left_m_s,right_m_s\n1e999999,0,0\n", "column t_s: '1e999999' is not finite or far too large"),
    ("t_ns,left_m_s,right_m_s\n1.5,0,0\n", "column t_ns: '1.5' is not a whole number"),
    ("t_s,left_m_s,right_m_s\n0,0,0\n1,250,250\n", "means a wheel at 250 m/s, above 20 m/s"),
    ("t_s,left_ticks,right_ticks\n0,0,0\n1,5,5\n", "the length of a tick is unknown; give --wheel-radius-m"),
    ("t_s,left_m_s,right_m_s\n0,\x000,0\n", "is not a number"),
    ("t_s,vx_m_s,vy_m_s\n0,0,0\n", "column 'omega_rad_s' is missing beside 'vx_m_s'"),
    ("t_s,x_m,y_m\n0,0,0\n", "column 'theta_rad' is missing beside 'x_m'"),
    ("t_s,v_m_s\n0,0\n", "needs exactly one of these sets of columns"),
    ("t_s,vx_m_s,vy_m_s,omega_rad_s\n0,0,0,0\n1,0,25,0\n", "means a wheel at 25 m/s, above 20 m/s"),
    ("t_s,x_m,y_m,theta_rad\n0,0,0,0\n1,0,300,0\n", "means a wheel at 300 m/s, above 20 m/s"),
    ("t_s,x_m,y_m,theta_rad\n0,0,0,0\n1,0,nan,0\n", "line 3, column y_m: 'nan' is not finite"),
    ("t_s,v_m_s,steering_rad\n0,0,0\n1,1,0.1\n", "holds steering angles; give --wheelbase-m"),
]
BAD_GYROS = [
    ("", "gyro.csv: is empty"),
    ("t_s,omega\n0,0\n", "gyro.csv line 1: has the columns t_s,omega; use t_s,omega_rad_s (or t_ns)"),
    ("omega_rad_s\n0\n", "gyro.csv line 1: has the columns omega_rad_s; use t_s,omega_rad_s (or t_ns)"),
    ("t_s,omega_rad_s\n0,0\n1,nan\n", "gyro.csv line 3, column omega_rad_s: 'nan' is not finite"),
    ("t_s,omega_rad_s\n0,0\n1,90\n", "gyro.csv line 3, column omega_rad_s: '90' must be below 50 rad/s; was it in deg"),
    ("t_s,omega_rad_s\n1,0\n0.5,0\n", "gyro.csv line 3, column t_s: '0.5' runs backwards after '1'"),
]


@contextmanager
def refusal(folder: Path, said: str) -> Iterator[None]:
    """One line that says so, and no log."""
    with pytest.raises(GroundsbotError) as caught:
        yield
    assert said in str(caught.value)
    assert not (folder / "logs").exists()


@pytest.mark.parametrize(("text", "said"), BAD_ODOMETRY)
def test_bad_odometry_is_refused_and_nothing_is_left(tmp_path: Path, text: str, said: str) -> None:
    with refusal(tmp_path, said):
        import_run(tmp_path, odometry=text)


@pytest.mark.parametrize(("text", "said"), BAD_GYROS)
def test_a_bad_gyro_is_refused_and_nothing_is_left(tmp_path: Path, text: str, said: str) -> None:
    folder = folder_with(tmp_path, {"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS, "gyro.csv": text})
    with refusal(tmp_path, said):
        import_folder(folder, tmp_path / "logs", TRACK)


def test_lines_end_where_csv_ends_them(tmp_path: Path) -> None:
    """Not at what else Unicode takes for the end of one, nor within quotes; lines are counted as editors do."""
    path = tmp_path / "table.csv"
    path.write_bytes('name,x\r\n"a\u2028b",1\r\n"c\x0b\x1cd",2\r\n"e\nf",3\r\n'.encode())
    table = read_table(path)
    assert table.text("name") == ["a\u2028b", "c\x0b\x1cd", "e\nf"]
    assert table.lines == [2, 3, 5]


BAD_OBSERVATIONS = [
    ("", "observations.csv: is empty"),
    ("t_s,x_m,y_m\n0,1,1\n", "column 'tag_id' is missing"),
    ("t_s,tag_id,x_m,bearing_rad\n0,1,1,1\n", "needs exactly one of these sets"),
    ("t_s,tag_id,x_m,y_m,sigma_x_m\n0,1,1,1,1\n", "column 'sigma_y_m' is missing beside 'sigma_x_m'"),
    ("t_s,tag_id,x_m,y_m,sigma_range_m\n0,1,1,1,1\n", "'sigma_range_m' does not go with x_m,y_m"),
    ("t_s,tag_id,x_m,y_m,sigma_x_m,sigma_y_m\n0,1,1,1,0,1\n", "column sigma_x_m: '0' must be above 0"),
    ("t_s,tag_id,x_m,y_m,sigma_x_m,sigma_y_m\n0,1,1,1,1e200,1\n", "sigma_x_m: '1e200' must be below 1000"),
    ("t_s,tag_id,x_m,y_m\n0,-1,1,1\n", "column tag_id: '-1' is outside 0 to 586"),
    ("t_s,tag_id,x_m,y_m\n0,587,1,1\n", "column tag_id: '587' is outside 0 to 586"),
    ("t_s,tag_id,x_m,y_m\n0,1.5,1,1\n", "column tag_id: '1.5' is not a whole number"),
    ("t_s,tag_id,x_m,y_m\n1,1,1,1\n0,1,1,1\n", "line 3, column t_s: '0' runs backwards after '1'"),
    ("t_s,tag_id,x_m,y_m\n1,1,0,0\n", "puts the tag at the robot's origin"),
    ("t_s,tag_id,range_m,bearing_rad\n1,1,-2,0\n", "column range_m: '-2' must be above 0"),
    ("t_s,tag_id,range_m,bearing_rad\n1,1,2,30\n", "column bearing_rad: '30' is more than a whole turn"),
    ("t_s,tag_id,x_m,y_m\n1000,1,1,1\n", "none of 1 observation lies within the odometry's time"),
]


@pytest.mark.parametrize(("text", "said"), BAD_OBSERVATIONS)
def test_bad_observations_are_refused_and_nothing_is_left(tmp_path: Path, text: str, said: str) -> None:
    with refusal(tmp_path, said):
        import_run(tmp_path, observations=text)


BAD_PAPER_FILES = [
    ("1,0,0\n3,0,0\n", "", "odom.csv line 2, column state: '3' comes where 2 belongs"),
    ("state,left,right\n1,0,0\n", "", "odom.csv line 1, column state: 'state' is not a number"),
    ("1,0\n", "", "odom.csv line 1: has 2 cells, needs 3"),
    ("1,0,0\n2,500,0\n", "", "odom.csv line 2, column v_left_m_s: '500' means a wheel at 500 m/s"),
    ("1,0,0\n", "", "landmarks.csv: is empty"),
    ("1,0,0\n", "2,5,1,1,0\n", "landmarks.csv line 1, column state: '2' is beyond the last state in odom.csv, 1"),
    ("1,0,0\n", "1,5,1,1,0\n0,5,1,1,0\n", "landmarks.csv line 2, column state: '0' runs backwards after 1"),
    ("1,0,0\n", "1,5,1,nan,0\n", "column right_m: 'nan' is not finite"),
]


@pytest.mark.parametrize(("odometry", "landmarks", "said"), BAD_PAPER_FILES)
def test_bad_files_in_the_papers_form_are_refused(tmp_path: Path, odometry: str, landmarks: str, said: str) -> None:
    folder = folder_with(tmp_path, {"odom.csv": odometry, "landmarks.csv": landmarks})
    with refusal(tmp_path, said):
        import_folder(folder, tmp_path / "logs", PAPER)


@pytest.mark.parametrize(
    ("files", "options", "said"),
    [
        ({}, TRACK, "holds none of the pairs odometry.csv + observations.csv or odom.csv + landmarks.csv; give the"),
        ({"odometry.csv": ODOMETRY}, TRACK, "observations.csv: is missing beside odometry.csv; add it"),
        ({"odometry.csv": ODOMETRY, "odom.csv": ""}, TRACK, "holds both pairs of"),
        ({"odom.csv": "1,0,0\n", "landmarks.csv": "1,1,1,1,0\n"}, TRACK, "give --state-rate-hz"),
        ({"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS}, PAPER, "leave it out"),
        ({"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS}, ImportOptions(), "give --track-width-m"),
        (
            {"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS},
            ImportOptions(track_width_m=0.5, tag_family="tag99"),
            "--tag-family is 'tag99', must be one of tag36h11",
        ),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, files: dict[str, str], options: ImportOptions, said: str) -> None:
    folder = folder_with(tmp_path, files)
    with refusal(tmp_path, said):
        import_folder(folder, tmp_path / "logs", options)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_options_must_be_sane(value: float) -> None:
    with pytest.raises(GroundsbotError, match=r"--track-width-m is .*, must be above 0"):
        ImportOptions(track_width_m=value)


@pytest.mark.parametrize("rate_hz", [1e12, 1e-300, 1e-9])
def test_states_come_as_often_as_a_robot_has_them(rate_hz: float) -> None:
    with pytest.raises(GroundsbotError, match=r"--state-rate-hz is .*, must be 0\.1 to 1000 states a second"):
        ImportOptions(state_rate_hz=rate_hz)


def test_what_is_hidden_in_the_output_is_no_hindrance(tmp_path: Path) -> None:
    """Another import may be under way, and some desktops leave files of their own."""
    (tmp_path / "logs" / ".monday.77.partial").mkdir(parents=True)
    (tmp_path / "logs" / ".DS_Store").touch()
    assert import_run(tmp_path).run_folder.is_dir()


def test_a_folder_that_is_no_log_is_never_to_be_removed(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, {"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS})
    with pytest.raises(GroundsbotError, match="exists, and is no run's log; give another output"):
        import_folder(folder, folder.parent, TRACK)
    assert (folder / "odometry.csv").is_file()


def test_an_output_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, {"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS})
    (tmp_path / "logs").mkdir()
    import_folder(folder, tmp_path / "logs", TRACK)  # an empty folder will do
    before = (tmp_path / "logs" / "drive" / "0000.core.mcap").read_bytes()
    with pytest.raises(GroundsbotError, match="exists already; give another output, another --run-id"):
        import_folder(folder, tmp_path / "logs", TRACK)
    assert (tmp_path / "logs" / "drive" / "0000.core.mcap").read_bytes() == before
    (tmp_path / "logs" / "letter.txt").write_text("dear")
    with pytest.raises(GroundsbotError, match=r"is not empty: letter\.txt is not a run's log"):
        import_folder(folder, tmp_path / "logs", ImportOptions(track_width_m=0.5, run_id="other"))
    assert sorted(entry.name for entry in (tmp_path / "logs").iterdir()) == ["drive", "letter.txt"]


def test_a_failure_while_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, written = LogWriter.write, []

    def fail_later(self: LogWriter, topic: str, message: PlanarOdometry, log_time_ns: int, publish_ns: int) -> None:
        written.append(topic)
        if len(written) == 4:
            raise OSError(28, "No space left on device")
        write(self, topic, message, log_time_ns, publish_ns)

    monkeypatch.setattr(LogWriter, "write", fail_later)
    with pytest.raises(GroundsbotError, match="drive: cannot be written: No space left on device"):
        import_run(tmp_path)
    assert not (tmp_path / "logs").exists()
