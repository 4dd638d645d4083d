"""Files and folders that are there whole or not at all."""

import os
import socket
from pathlib import Path

import pytest

from groundsbot.calib.camera.file import read_camera_yaml
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation.files import atomic_write, folder_written_whole, read_regular
from groundsbot.calib.foundation.yaml_file import read_text


def spoilt(file: Path) -> None:
    """Writes some and fails."""
    file.write_text("half")
    raise ZeroDivisionError


def all_below(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*"))


def test_a_file_appears_whole_or_stays_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with atomic_write(path) as partial:
        partial.write_text("first")
        assert not path.exists()
    with pytest.raises(ZeroDivisionError), atomic_write(path) as partial:
        spoilt(partial)
    assert path.read_text() == "first"
    assert all_below(tmp_path) == [path]


def test_a_folder_appears_whole_with_the_folders_on_the_way(tmp_path: Path) -> None:
    folder = tmp_path / "way" / "there"
    with folder_written_whole(folder) as partial:
        (partial / "file").write_text("all")
        assert not folder.exists()
    assert (folder / "file").read_text() == "all"
    assert all_below(tmp_path) == [tmp_path / "way", folder, folder / "file"]


def test_a_folder_takes_the_place_of_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    (folder / "sub").mkdir(parents=True)
    with folder_written_whole(folder, replace=True) as partial:
        (partial / "new").write_text("")
        assert (folder / "sub").is_dir()
    assert all_below(tmp_path) == [folder, folder / "new"]


def test_what_came_into_the_folder_meanwhile_stays(tmp_path: Path) -> None:
    folder = tmp_path / "folder"

    def write_beside_another() -> None:
        with folder_written_whole(folder) as partial:
            (partial / "file").write_text("new")
            folder.mkdir()
            (folder / "file").write_text("precious")

    with pytest.raises(CalibError, match="folder: is not empty any more, and its content is kept; name another folder"):
        write_beside_another()
    assert (folder / "file").read_text() == "precious"
    assert all_below(tmp_path) == [folder, folder / "file"]


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    with folder_written_whole(folder) as partial:
        (partial / "file").write_text("new")
    assert all_below(tmp_path) == [folder, folder / "file"]


@pytest.mark.parametrize("existing", [False, True])
def test_a_failure_leaves_all_as_it_was(tmp_path: Path, existing: bool) -> None:
    folder = tmp_path / "way" / "there"
    if existing:
        folder.mkdir(parents=True)
        (folder / "file").write_text("old")
    before = all_below(tmp_path)
    with pytest.raises(ZeroDivisionError), folder_written_whole(folder) as partial:
        spoilt(partial / "file")
    assert all_below(tmp_path) == before
    assert not existing or (folder / "file").read_text() == "old"


def test_what_was_there_comes_back_if_it_cannot_be_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "file").write_text("old")
    rename = Path.rename

    def fail(self: Path, target: Path) -> Path:
        if self.name.endswith(".partial"):
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with (
        pytest.raises(CalibError, match=r"folder: cannot be written \(Input/output error\); name a folder"),
        folder_written_whole(folder, replace=True) as partial,
    ):
        (partial / "file").write_text("new")
    assert (folder / "file").read_text() == "old"
    assert all_below(tmp_path) == [folder, folder / "file"]


def test_a_folder_that_cannot_be_made_is_reported_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(CalibError, match=r"file/folder: cannot be written \(Not a directory\)"),
        folder_written_whole(tmp_path / "file" / "folder"),
    ):
        pytest.fail("the block must not run")


def test_a_mount_point_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "is_mount", lambda self: self == tmp_path)
    with (
        pytest.raises(CalibError, match="is a mount point"),
        folder_written_whole(tmp_path),
    ):
        pytest.fail("the block must not run")


def test_files_of_a_killed_process_with_the_same_number_do_no_harm(tmp_path: Path) -> None:
    file, folder = tmp_path / "file", tmp_path / "folder"
    file.with_name(f".file.{os.getpid()}.partial").write_text("half")
    with atomic_write(file) as partial, partial.open("x") as opened:
        opened.write("whole")
    for word in ("partial", "replaced"):  # killed while the folder had no name
        (tmp_path / f".folder.{os.getpid()}.{word}").mkdir()
        (tmp_path / f".folder.{os.getpid()}.{word}" / word).touch()
    with pytest.raises(ZeroDivisionError), folder_written_whole(folder, replace=True) as partial:
        spoilt(partial / "new")
    assert all_below(tmp_path) == [file, folder, folder / "replaced"]


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, sizes, fsync = tmp_path / "file", list[int](), os.fsync

    def synced(file: int) -> None:
        assert not path.exists()
        sizes.append(os.fstat(file).st_size)
        fsync(file)

    monkeypatch.setattr(os, "fsync", synced)
    with atomic_write(path) as partial:
        partial.write_text("whole")
    assert sizes == [5]
    with atomic_write(path, durable=False) as partial:
        partial.write_text("of now")
    assert sizes == [5]


def test_a_folder_has_its_name_once_all_in_it_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(Path(f"/proc/self/fd/{file}").readlink().name))
    folder = tmp_path / "folder"
    with folder_written_whole(folder) as partial:
        (partial / "sub").mkdir()
        (partial / "sub" / "file").write_text("all")
    assert sorted(synced[:2]) == ["file", "sub"]
    assert synced[2:] == [partial.name, tmp_path.name]  # the new name comes last


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("device", "is a device"),
        ("link to a device", "is a device"),
        ("fifo", "is a FIFO"),
        ("folder", "is a folder"),
        ("sparse", "limit 16777216"),
        ("socket", "is a socket"),
    ],
)
def test_a_yaml_file_that_is_none_is_refused_without_being_read(tmp_path: Path, kind: str, said: str) -> None:
    """A device may have no end, and who opens a FIFO waits for a writer."""
    path = tmp_path / "camera.yaml"
    if kind == "device":
        path = Path("/dev/zero")
    elif kind == "link to a device":
        path.symlink_to("/dev/zero")
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))
    else:
        with path.open("wb") as file:
            file.truncate(3 << 30)
    with pytest.raises(CalibError, match=said) as refused:
        read_camera_yaml(path)
    assert str(path) in str(refused.value)


def test_a_link_to_a_file_is_read_where_links_are_followed(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"a\r\nb\rc\n")
    (link := tmp_path / "link").symlink_to("file")
    assert read_regular(link, 7) == b"a\r\nb\rc\n"
    assert read_text(link) == "a\nb\nc\n"
    with pytest.raises(CalibError, match="is a link"):
        read_regular(link, 7, follow_links=False)
    with pytest.raises(CalibError, match="has 7 bytes, limit 6"):
        read_regular(link, 6)


def test_a_file_that_claims_no_size_is_limited_all_the_same() -> None:
    """As those of /proc do."""
    with pytest.raises(CalibError, match="has more than 10 bytes"):
        read_regular(Path("/proc/self/status"), 10)
