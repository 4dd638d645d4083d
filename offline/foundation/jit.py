"""Compiled inner loops: numba with its cache on disk, and without where nothing may be written."""

import hashlib
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numba
from numba import extending
from numba.core import event, types

from groundsbot.calib.robot import CAMERA_PARAMETERS

_CACHE_NAME: Final = re.compile(r"solver-[0-9a-f]{16}")
_COMPILED: Final = re.compile(rb"^ *@(njit|inner|inline)\b", re.MULTILINE)  # the decorators below
_KEPT_UNUSED_S: Final = 30 * 86_400.0

COMPILING: Final = "compiling the solver, this once; some twenty seconds"

_T = TypeVar("_T")
_F = TypeVar("_F", bound=Callable[..., object])


# Sums are contracted into fused multiply-adds but never reordered, so that a result does not depend on the machine's
# vector width. Nobody calls these functions from C. They hold no lock of Python's, so that segments may share out
# cores.
_OPTIONS: Final = {"error_model": "numpy", "fastmath": {"contract"}, "no_cfunc_wrapper": True, "nogil": True}
_njit: Final[Any] = numba.njit  # its types leave some options out


def njit(function: _F) -> _F:
    """Compiled on first call; kept on disk beside the source or in the user's cache folder, if one can be written."""
    try:
        compiled = _njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba found no folder that it may write to
        compiled = _njit(**_OPTIONS)(function)
    return cast("_F", compiled)


def inner(function: _F) -> _F:
    """Compiled for compiled functions to call, not for Python; kept on disk within those that call it.

    The way in from Python takes apart each array of each tuple, which took a quarter of the time to compile.
    """
    return cast("_F", _njit(no_cpython_wrapper=True, **_OPTIONS)(function))


def inline(function: _F) -> _F:
    """As `inner`, but written out wherever it is called, before types are known: for what inner loops call once or so.

    Left to itself the compiler keeps calls of what is long. Written out, observations take a quarter less time and the
    pass of starting values a third; odometry and elimination gained nothing, and took longer to compile.
    """
    return cast("_F", _njit(inline="always", no_cpython_wrapper=True, **_OPTIONS)(function))


if TYPE_CHECKING:

    def borrow(value: _T) -> _T:
        """For use inside compiled functions: arrays, or a tuple of them, whose references are not counted."""
        return value

else:

    @extending.intrinsic
    def borrow(_context, value):  # noqa: ANN001, ANN201 (numba's code generation carries no types)
        """For use inside compiled functions: arrays, or a tuple of them, whose references are not counted.

        Whoever passes a tuple of many arrays on pays for counting each of them up and down again, atomically; inner
        loops spent two fifths of their time on that. Only for arguments: the caller holds them while the function runs.
        """

        def without_count(context, builder, kind, item):  # noqa: ANN001, ANN202
            if isinstance(kind, types.Array):
                array = context.make_array(kind)(context, builder, value=item)
                array.meminfo = array.meminfo.type(None)
                return array._getvalue()
            if isinstance(kind, types.BaseTuple):
                members = [builder.extract_value(item, i) for i in range(len(kind))]
                kept = [without_count(context, builder, own, one) for own, one in zip(kind, members, strict=True)]
                return context.make_tuple(builder, kind, kept)
            return item

        def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
            return without_count(context, builder, signature.args[0], arguments[0])

        return value(value), generate


class _Announcer(event.Listener):
    """Tells of the first compilation, and only of that."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell: Callable[[str], None] | None = tell

    def on_start(self, event: object) -> None:
        """Called by numba when it begins to compile; not when it loads from the cache."""
        if self._tell is not None:
            self._tell(COMPILING)
            self._tell = None

    def on_end(self, event: object) -> None:
        """Called by numba when it is done."""


@contextmanager
def announce_compilation(tell: Callable[[str], None]) -> Iterator[None]:
    """Has the block's first compilation told of; a block that finds all in the cache stays silent."""
    announcer = _Announcer(tell)
    event.register("numba:compile", announcer)  # type: ignore[no-untyped-call] # numba's own
    try:
        yield
    finally:
        event.unregister("numba:compile", announcer)  # type: ignore[no-untyped-call] # numba's own


def _kernel_hash() -> str:
    """Of all files of the package with compiled functions: numba's cache looks only at the file of the function called.

    How they are compiled, which this file says, counts too, and so do the calibration parameters, whose number is a
    constant in them.
    """
    digest = hashlib.sha256(Path(__file__).read_bytes() + repr(CAMERA_PARAMETERS).encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        source = path.read_bytes()
        if _COMPILED.search(source):
            digest.update(source)
    return digest.hexdigest()[:16]


def _keep_cache_apart() -> None:
    """A cache folder for these sources alone, so that an edit of one file is never met by code of the old one."""
    beside = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent / "__pycache__")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "groundsbot"
    for root in (beside, home):
        folder = root / f"solver-{_kernel_hash()}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
            os.utime(folder)  # when it was last used: what lies in it is only read
        except OSError:
            continue
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined] # numba fills its config at run time
        _remove_old_folders(root)
        return


def _remove_old_folders(root: Path) -> None:
    """Folders that updates left behind. Another version may be in use beside this one, but then not for so long unused.

    Should it be after all, it compiles once more: numba takes files that are gone for files that never were.
    """
    oldest_s = time.time() - _KEPT_UNUSED_S
    for folder in root.glob("solver-*"):
        with suppress(OSError):
            if _CACHE_NAME.fullmatch(folder.name) and not folder.is_symlink() and folder.stat().st_mtime < oldest_s:
                shutil.rmtree(folder)


_keep_cache_apart()
