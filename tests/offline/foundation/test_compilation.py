"""Kernels that are compiled before their first call."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numba
import numpy as np
import pytest
from numba.core import types

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.commands import compilation as of_maps
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import FloatMatrix, FloatVector, IntVector, Stages, compilation, compile_ahead, jit
from groundsbot.offline.foundation.kernel_types import argument_types

_typeof: Final[Any] = numba.typeof  # it has no types of its own

MODULES = ("noise.lasting_errors", "sam.arrowhead.dissection")

COMPILE = f"""
from groundsbot.offline.foundation import Stages, compilation
if __name__ == "__main__":
    compilation.possible_workers = lambda: 2
    compilation.compile_ahead({MODULES}, print, Stages())
"""

CALL = """
import numpy as np
from groundsbot.offline.foundation import announce_compilation
from groundsbot.offline.noise.lasting_errors import LastingErrors
with announce_compilation(print):
    errors = LastingErrors(np.arange(3), np.array([0.0, 0.5, 0.5]))
    errors.correlation_sums(), errors.correlate(np.ones((3, 2))), errors.times(np.ones((3, 2)))
"""


def test_what_was_compiled_ahead_is_not_compiled_again(tmp_path: Path) -> None:
    """Neither by the same call in the next process, nor where the kernels are called."""

    def told(program: str) -> str:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=True)
        return done.stdout.decode()

    assert [told(COMPILE), told(COMPILE), told(CALL)] == [f"{jit.COMPILING}\n", "", ""]


def test_a_full_disk_ends_no_command(tmp_path: Path) -> None:
    """Code that cannot be written is used all the same."""
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", limit + CALL], env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stderr.decode()) == (0, "")


def test_types_are_those_of_the_arguments() -> None:
    class Pair(NamedTuple):
        first: FloatVector
        second: int

    class Same(NamedTuple):
        first: IntVector
        second: IntVector

    def kernel(pair: Pair, same: Same, matrix: FloatMatrix, limits: tuple[float, float], is_forward: bool) -> None: ...

    values = (
        Pair(np.zeros(2), 1), Same(np.zeros(2, dtype=np.int64), np.zeros(0, dtype=np.int64)), np.zeros((2, 3)),
        (0.5, 1.0), True,
    )  # fmt: skip
    assert argument_types(kernel) == tuple(map(_typeof, values))


def test_an_array_without_dimensions_is_refused() -> None:
    def kernel(vector: FloatVector, other: FloatArray) -> None: ...

    with pytest.raises(TypeError, match="kernel: other"):
        argument_types(kernel)


def test_dimensions_are_part_of_the_type() -> None:
    def kernel(vector: Annotated[FloatArray, types.float64[::1]]) -> None: ...

    assert argument_types(kernel) == (_typeof(np.zeros(3)),) != (_typeof(np.zeros(6)[::2]),)


def test_all_kernels_of_maps_are_compiled_ahead() -> None:
    """All entries in the rooms whose kernels every map needs, with arguments of known types."""
    package = Path(jit.__file__).parents[1]
    found = {
        ".".join(path.relative_to(package).with_suffix("").parts)
        for room in ("estimate", "measurements", "noise", "sam", "self_calibration")
        for path in (package / room).rglob("*.py")
        if "\n@njit\n" in path.read_text(encoding="utf-8")
    }
    assert found == set(of_maps.MODULES)
    for module in found:
        importlib.import_module(f"groundsbot.offline.{module}")
        for kernel in jit.KERNELS[f"groundsbot.offline.{module}"]:
            assert argument_types(kernel.py_func)


def test_nothing_is_compiled_ahead_where_no_cache_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "cache_folder", lambda: None)
    monkeypatch.setattr(compilation, "possible_workers", lambda: 2)
    told: list[str] = []
    compile_ahead(MODULES, told.append, Stages())
    assert not told


@pytest.mark.parametrize("error", [OfflineError("its process was killed"), OSError(28, "No space left on device")])
def test_a_compilation_that_was_cut_off_is_done_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception
) -> None:
    class Failing:
        def map(self, *_arguments: object) -> None:
            raise error

        def __enter__(self) -> "Failing":
            return self

        def __exit__(self, *_error: object) -> None: ...

    monkeypatch.setattr(compilation, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(compilation, "possible_workers", lambda: 2)
    monkeypatch.setattr(compilation, "worker_processes", lambda _n: Failing())
    told: list[str] = []
    for _ in range(2):
        compile_ahead(MODULES, told.append, Stages())
    assert told == 2 * [jit.COMPILING]
