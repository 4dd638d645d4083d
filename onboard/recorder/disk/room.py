"""Room on the recorder's disk: a ballast to finish files with, what goes when space is little, one recorder a robot."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.calib.robot import Robot
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import CAMERA_SUFFIX, Storage

BALLAST_BYTES: Final = 16 << 20  # half a second of everything, and the indices of a segment
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT)
_LEAST_BYTES: Final = 4 << 20  # beside the ballast, for a file to be begun


class SpacePolicy(NamedTuple):
    """What to do when space is little."""

    keep_free_bytes: int = 512 << 20  # below this, pictures are not kept any more
    remove_old_pictures: bool = False  # unless finished files of pictures, oldest first, may be removed for new ones


def space_policy(robot: Robot) -> SpacePolicy:
    """What a robot's robot.yaml says about it."""
    return SpacePolicy(robot.recorder.keep_free_mb * 1_000_000, robot.recorder.remove_old_pictures)


class DiskRoom:
    """The room in the folder where runs go."""

    def __init__(self, storage: Storage, folder: Path, robot_id: str, policy: SpacePolicy) -> None:
        """Makes nothing yet.

        Args:
            storage: where.
            folder: where run folders go.
            robot_id: names the ballast, so that several robots can record into one folder.
            policy: what to do when space is little.
        """
        self._storage = storage
        self._folder = folder
        self._ballast = folder / f".{robot_id}.ballast"
        self._policy = policy

    def take_ballast(self) -> None:
        """Sees to it that the ballast is there.

        Raises:
            OSError: there is no room for it and a file beside it.
        """
        self._storage.make_folder(self._folder)
        if self._storage.size_bytes(self._ballast) >= BALLAST_BYTES:
            return
        if self._storage.exists(self._ballast):  # a kill or a full disk left it too small
            self._storage.remove(self._ballast)
        if self.free_bytes() < BALLAST_BYTES + _LEAST_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._folder))
        self._storage.reserve(self._ballast, BALLAST_BYTES)

    def drop_ballast(self) -> None:
        """Gives its room to whoever writes next."""
        with suppress(OSError):
            self._storage.remove(self._ballast)

    def free_bytes(self) -> int:
        """Room left.

        Raises:
            OSError: nobody knows.
        """
        return self._storage.free_bytes(self._folder)

    def is_low(self) -> bool:
        """Whether there is less room than shall be kept free."""
        try:
            return self.free_bytes() < self._policy.keep_free_bytes
        except OSError:
            return False

    def remove_old_pictures(self) -> list[Path]:
        """Makes room, if that is allowed, by removing finished files of pictures: oldest first, and none too many.

        Returns:
            What was removed.
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
    """Finished files of pictures in run folders: a name that ends so is given to a file when nothing writes it more."""
    found: list[tuple[int, Path]] = []
    for path in folder.glob(f"*/*{CAMERA_SUFFIX}"):
        with suppress(OSError):
            found.append((path.lstat().st_mtime_ns, path))
    return [path for _, path in sorted(found)]


@contextmanager
def one_recorder(robot_file: Path, folder: Path, robot_id: str) -> Iterator[None]:
    """Holds a robot for one recorder: by its robot.yaml, and by its id in the folder where its runs go.

    The kernel lets go when the process ends, however it ends. On a full disk robot.yaml holds alone: recording begins
    when there is room.

    Raises:
        OnboardError: another recorder has it, or the folder cannot be written.
    """
    with ExitStack() as held:
        try:
            held.callback(os.close, _lock(robot_file, os.O_RDONLY))
            try:
                folder.mkdir(parents=True, exist_ok=True)
                held.callback(os.close, _lock(folder / f".{robot_id}.lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW))
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


def _lock(path: Path, flags: int) -> int:
    file = os.open(path, flags | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        raise
    return file
