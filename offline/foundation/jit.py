"""Decorators for compiled inner loops: numba with a cache on disk, or without one where no folder is writable."""

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

COMPILING: Final = "compiling the solver, once after an update; this takes 10 to 60 s"
KERNELS: Final[dict[str, list[Any]]] = {}  # functions with an entry point from Python, by module

_T = TypeVar("_T")
_F = TypeVar("_F", bound=Callable[..., object])


# Sums are contracted into fused multiply-adds but not reordered, so results do not depend on the machine's vector
# width. No function is called from C. The interpreter's lock is released, so that threads can work in parallel.
_OPTIONS: Final = {"error_model": "numpy", "fastmath": {"contract"}, "no_cfunc_wrapper": True, "nogil": True}
_njit: Final[Any] = numba.njit  # its type stubs lack some of the options


def njit(function: _F) -> _F:
    """Compile a function on its first call; the code is cached beside the source or in the user's cache folder."""
    try:
        compiled = _njit(cache=True, **_OPTIONS)(function)
        _save_where_possible(compiled)
    except RuntimeError:  # numba found no folder that it may write to
        compiled = _njit(**_OPTIONS)(function)
    KERNELS.setdefault(function.__module__, []).append(compiled)
    return cast("_F", compiled)


def _save_where_possible(compiled: Any) -> None:  # noqa: ANN401 (numba's dispatcher)
    """Have compiled code used without being kept where it cannot be written, as on a full disk."""
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined] # at run time
        return
    save = compiled._cache.save_overload

    def save_where_possible(*code: object) -> None:
        with suppress(OSError):
            save(*code)

    compiled._cache.save_overload = save_where_possible


def inner(function: _F) -> _F:
    """Compile a function that only compiled functions call; it is cached within those.

    It has no entry point from Python, whose unpacking of tuples of arrays took a quarter of the compile time.
    """
    return cast("_F", _njit(no_cpython_wrapper=True, **_OPTIONS)(function))


def inline(function: _F) -> _F:
    """Compile a function as `inner` does, and inline it into every caller before type inference.

    The compiler does not inline long functions by itself. Inlining saves a quarter of the time of observations and a
    third of that of the initialisation. Odometry and elimination gain nothing and take longer to compile.
    """
    return cast("_F", _njit(inline="always", no_cpython_wrapper=True, **_OPTIONS)(function))


if TYPE_CHECKING:

    def borrow(value: _T) -> _T:
        """Return arrays, or a tuple of them, without reference counting; for use inside compiled functions."""
        return value

else:

    @extending.intrinsic
    def borrow(_context, value):  # noqa: ANN001, ANN201 (numba's code generation carries no types)
        """Return arrays, or a tuple of them, without reference counting; for use inside compiled functions.

        Passing a tuple of many arrays to a function increments and decrements each reference count atomically, which
        took two fifths of the time of inner loops. The value must be an argument of the calling function, so that its
        caller keeps the references alive.
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
    """A listener that passes on a message at the first compilation only."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify: Callable[[str], None] | None = notify

    def on_start(self, event: object) -> None:
        """Pass on the message; numba calls this when it begins to compile, not when it loads from the cache."""
        if self._notify is not None:
            self._notify(COMPILING)
            self._notify = None

    def on_end(self, event: object) -> None:
        """Do nothing; numba calls this at the end of a compilation."""


@contextmanager
def announce_compilation(notify: Callable[[str], None]) -> Iterator[None]:
    """Call `notify` with a message at the first compilation in the block; not at all where everything is cached."""
    announcer = _Announcer(notify)
    event.register("numba:compile", announcer)  # type: ignore[no-untyped-call] # numba's own
    try:
        yield
    finally:
        event.unregister("numba:compile", announcer)  # type: ignore[no-untyped-call] # numba's own


def cache_folder() -> Path | None:
    """Return the folder of compiled code; None where no folder is writable, or where nothing is to be compiled."""
    return None if _cache is None or numba.config.DISABLE_JIT else _cache  # type: ignore[attr-defined] # at run time


def _kernel_hash() -> str:
    """Return a hash of all files of the package with compiled functions.

    Numba's cache checks only the file of the function that is called, not those of functions called by it. The hash
    includes this file, which has the compiler's options, and the names of the calibration parameters, whose number is a
    constant in the compiled code.
    """
    digest = hashlib.sha256(Path(__file__).read_bytes() + repr(CAMERA_PARAMETERS).encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        source = path.read_bytes()
        if _COMPILED.search(source):
            digest.update(source)
    return digest.hexdigest()[:16]


def _keep_cache_apart() -> Path | None:
    """Set numba's cache folder to one that is used for exactly these sources, so that no outdated code is loaded.

    Returns:
        The folder; None where no folder is writable.
    """
    beside = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent / "__pycache__")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "groundsbot"
    for root in (beside, home):
        folder = root / f"solver-{_kernel_hash()}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
            os.utime(folder)  # records the time of use, because reading cached code does not
        except OSError:
            continue
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined] # numba fills its config at run time
        _remove_old_folders(root)
        return folder
    return None


def _remove_old_folders(root: Path) -> None:
    """Remove cache folders of earlier versions that have not been used for 30 days.

    A version that is still in use and loses its folder compiles again, because numba treats missing files as uncached.
    """
    oldest_s = time.time() - _KEPT_UNUSED_S
    for folder in root.glob("solver-*"):
        with suppress(OSError):
            if _CACHE_NAME.fullmatch(folder.name) and not folder.is_symlink() and folder.stat().st_mtime < oldest_s:
                shutil.rmtree(folder)


_cache: Final = _keep_cache_apart()
