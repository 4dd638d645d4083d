"""Space on the recorder's disk: a reserve to finish files, removal of old pictures, and a lock for each robot."""

import errno
import fcntl
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.calib.robot import Robot
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import CAMERA_SUFFIX, FOLDER_MODE, Storage

BALLAST_BYTES: Final = 16 << 20  # enough for half a second of data and the indexes of a segment
LEAST_BYTES: Final = 256 << 10  # free space needed to begin files: their heads, some data and an index
_LOCK_MODE: Final = 0o600
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT)


class SpacePolicy(NamedTuple):
    """Policy for low disk space."""

    keep_free_bytes: int = 512 << 20  # below this, pictures are not kept
    remove_old_pictures: bool = False  # remove finished files of pictures first, oldest first


def space_policy(robot: Robot) -> SpacePolicy:
    """Return the policy of robot.yaml."""
    return SpacePolicy(robot.recorder.keep_free_mb * 1_000_000, robot.recorder.remove_old_pictures)


class DiskRoom:
    """Management of the disk space of the folder for runs."""

    def __init__(self, storage: Storage, folder: Path, robot_id: str, policy: SpacePolicy) -> None:
        """Prepare; no file is made yet.

        Args:
            storage: the disk.
            folder: folder for run folders.
            robot_id: part of the ballast's name, so that several robots can record into one folder.
            policy: policy for low disk space.
        """
        self._storage = storage
        self._folder = folder
        self._ballast = folder / f".{robot_id}.ballast"
        self._policy = policy

    @property
    def ballast_bytes(self) -> int:
        """Size of the ballast; 0 without one."""
        return self._storage.size_bytes(self._ballast)

    @property
    def is_short(self) -> bool:
        """Whether the ballast is smaller than it should be, because the disk is nearly full."""
        return self.ballast_bytes < BALLAST_BYTES

    def take_ballast(self) -> None:
        """Reserve half of the free space, at most BALLAST_BYTES, if the ballast is smaller than that.

        The files written beside it are as large as the ballast when the disk is full, so that their indexes fit into
        its space. The next files then take half of what is left, until the disk is full.

        Raises:
            OSError: there is no space to begin a file.
        """
        self._storage.make_folder(self._folder)
        size_bytes = self.ballast_bytes
        wanted_bytes = min(BALLAST_BYTES, (self.free_bytes() + size_bytes) // 2)
        if size_bytes >= wanted_bytes > 0:
            return
        if self._storage.exists(self._ballast):  # too small after a kill or on a full disk
            self._storage.remove(self._ballast)
        if wanted_bytes < LEAST_BYTES // 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._folder))
        while wanted_bytes >= LEAST_BYTES // 2:
            try:
                self._storage.reserve(self._ballast, wanted_bytes)
                return
            except OSError as error:  # a quota may leave less than the disk has
                if error.errno not in NO_ROOM:
                    raise
                wanted_bytes //= 2

    def drop_ballast(self) -> None:
        """Remove the ballast, so that its space can be used."""
        with suppress(OSError):
            self._storage.remove(self._ballast)

    def free_bytes(self) -> int:
        """Return the free space.

        Raises:
            OSError: the free space cannot be determined.
        """
        return self._storage.free_bytes(self._folder)

    def is_low(self) -> bool:
        """Return whether the free space is below `keep_free_bytes`; False if it is unknown."""
        try:
            return self.free_bytes() < self._policy.keep_free_bytes
        except OSError:
            return False

    def remove_old_pictures(self) -> list[Path]:
        """Remove finished files of pictures, oldest first, while space is low, if the policy allows it.

        Returns:
            The files removed.
        """
        removed: list[Path] = []
        if not self._policy.remove_old_pictures:
            return removed
        for path in _oldest_first(self._folder):
            if not self.is_low():
                break
            with suppress(OSError):
                self._storage.remove(path)
                removed.append(path)
        return removed


def _oldest_first(folder: Path) -> list[Path]:
    """Return the finished files of pictures in run folders, by age; a file has this name only when it is finished."""
    found: list[tuple[int, Path]] = []
    for path in folder.glob(f"*/*{CAMERA_SUFFIX}"):
        with suppress(OSError):
            found.append((path.lstat().st_mtime_ns, path))
    return [path for _, path in sorted(found)]


@contextmanager
def one_recorder(robot_file: Path, folder: Path, robot_id: str) -> Iterator[None]:
    """Lock a robot for one recorder: by the path of its robot.yaml, and by its id in the folder for runs.

    The kernel releases the locks when the process ends in any way. On a full disk only the path is locked, and
    recording begins when there is space. Other users cannot open the locked files, as they could hold a lock as well.

    Raises:
        OnboardError: the robot is locked by another recorder, or the folder cannot be written.
    """
    with ExitStack() as held:
        try:
            path_digest = hashlib.sha256(os.fsencode(robot_file.resolve())).hexdigest()[:32]
            private = _private_folder()
            if private is not None:
                held.callback(os.close, _lock(private / f"{path_digest}.lock"))
            try:
                folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
                held.callback(os.close, _lock(folder / f".{robot_id}.lock"))
            except OSError as error:
                if error.errno not in NO_ROOM:
                    raise
        except BlockingIOError:
            raise OnboardError(
                f"{robot_file}: robot {robot_id} is being recorded already; stop that recorder first"
            ) from None
        except OSError as error:
            where = error.filename or folder
            raise OnboardError(f"{where}: cannot record here: {error.strerror}; choose another --output") from error
        yield


def _private_folder() -> Path | None:
    """Return a folder that only this user can enter, or None if there is none."""
    parents = [os.environ.get(name) for name in ("XDG_RUNTIME_DIR", "RUNTIME_DIRECTORY")]
    candidates = [Path(parent) / "groundsbot" for parent in parents if parent]
    for folder in (*candidates, Path(tempfile.gettempdir()) / f"groundsbot-{os.geteuid()}"):
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
            found = folder.lstat()
            if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077:
                return folder
    return None


def _lock(path: Path) -> int:
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, _LOCK_MODE)
    try:
        os.fchmod(file, _LOCK_MODE)  # one of an earlier version is readable by all
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        raise
    return file
