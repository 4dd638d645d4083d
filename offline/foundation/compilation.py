"""Compilation of kernels before their first call, in as many processes as there are cores.

Half of the time that numba takes is Python with the interpreter's lock, so that threads would not help. The processes
leave their code in the cache, from which others load it.
"""

import gc
import hashlib
import platform
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Final

import numba
from numba.core.registry import cpu_target

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.jit import COMPILING, KERNELS, cache_folder
from groundsbot.offline.foundation.kernel_types import argument_types
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.foundation.workers import possible_workers, worker_processes

_PACKAGE: Final = "groundsbot.offline"
_FOLDER: Final = Path(__file__).parents[1]
_STAGE: Final = "compiling the solver"


def compile_ahead(modules: Sequence[str], notify: Callable[[str], None], stages: Stages) -> None:
    """Compile the kernels of some modules, unless that was done before; `notify` is called with a message.

    Nothing is done where it cannot help: with a single core, or where no cache can be kept. Kernels are then compiled
    when they are first called, as where a process is killed, for lack of memory perhaps.

    Args:
        modules: names below `groundsbot.offline`; those that take longest first, so that all processes end together.
        notify: called before kernels are compiled.
        stages: records the time.
    """
    folder, n = cache_folder(), min(possible_workers(), len(modules))
    if folder is None or n == 1:
        return
    done = folder / f"compiled-{_fingerprint(modules)}"
    if done.exists():
        return
    notify(COMPILING)
    try:
        with worker_processes(n) as workers:
            workers.map(compile_module, modules, [f"{_STAGE}: {module}" for module in modules], stages, _STAGE)
    except (OfflineError, OSError):
        return
    with suppress(OSError):  # it is done again next time
        done.touch()


def compile_module(module: str, _stages: Stages) -> None:
    """Compile the kernels of a module, or load them from the cache."""
    gc.disable()  # the compiler makes many objects and little garbage; collections would take a sixth of the time
    try:
        import_module(f"{_PACKAGE}.{module}")
        for kernel in KERNELS[f"{_PACKAGE}.{module}"]:
            kernel.compile(argument_types(kernel.py_func))
    finally:
        gc.enable()


def _fingerprint(modules: Sequence[str]) -> str:
    """Return a hash of all that numba's cache depends on: versions, the processor, and the times of the files."""
    files = [_FOLDER.joinpath(*module.split(".")).with_suffix(".py") for module in modules]
    stamps = [(str(path), path.stat().st_mtime, path.stat().st_size) for path in files]
    processor = cpu_target.target_context.codegen().magic_tuple()
    text = repr((numba.__version__, platform.python_version(), processor, stamps))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
