"""Compiled code also where nothing may be written."""

import ast
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from groundsbot.offline.foundation import jit
from groundsbot.offline.foundation.jit import COMPILING, announce_compilation, njit


def test_compiles_where_no_cache_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    real = numba.njit

    def refusing(*functions: Any, cache: bool = False, **options: Any) -> Any:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return real(*functions, **options)

    monkeypatch.setattr(numba, "njit", refusing)

    def one_more(x: float) -> float:
        return x + 1.0

    assert njit(one_more)(1.0) == 2.0


def test_compiling_is_announced_once() -> None:
    told: list[str] = []

    def one_more(x: float | np.float32) -> float:
        return float(x + 1.0)

    compiled: Any = numba.njit(one_more)  # without a cache: it must compile each time
    with announce_compilation(told.append):
        assert not told
        assert (compiled(1.0), compiled(1)) == (2.0, 2)
    assert compiled(np.float32(1.0)) == 2.0  # compiles once more, after the block
    assert told == [COMPILING]


def make_package(folder: Path) -> Path:
    """A package `groundsbot.offline` with this module, and rooms `one` and `other` with nothing."""
    package = folder / "groundsbot" / "offline"
    for room in (package / "foundation", package / "one", package / "other" / "inside"):
        room.mkdir(parents=True)
    (package / "foundation" / "jit.py").write_text(Path(jit.__file__).read_text(encoding="utf-8"), encoding="utf-8")
    return package


def output_of(program: str, folder: Path, **more: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", **more}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout


def test_an_edit_of_any_kernel_leaves_the_old_cache_alone(tmp_path: Path) -> None:
    """A caller in one room must not be loaded with what a callee in another used to be."""
    package = make_package(tmp_path)
    callee, caller = package / "one" / "callee.py", package / "other" / "inside" / "caller.py"
    imported = "from groundsbot.offline.foundation.jit import inner, njit\n"
    caller.write_text(f"{imported}from groundsbot.offline.one.callee import f\n@njit\ndef g(x):\n    return f(x)\n")
    found = []
    for plus in ("1.0", "2.0"):
        callee.write_text(f"{imported}@inner\ndef f(x):\n    return x + {plus}\n")
        found.append(float(output_of("from groundsbot.offline.other.inside.caller import g; print(g(1.0))", tmp_path)))
    assert found == [2.0, 3.0]


def test_all_files_with_kernels_are_counted() -> None:
    decorators = {"njit", "inner", "inline"}
    package = Path(jit.__file__).parents[1]
    with_kernels = {path for path in package.rglob("*.py") if jit._COMPILED.search(path.read_bytes())}
    importing = {
        path
        for path in package.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and decorators & {name.name for name in node.names}
    }
    assert len(importing) > 20
    assert importing == with_kernels


def test_caches_that_were_not_used_for_long_are_removed(tmp_path: Path) -> None:
    """Only what is a cache by its name, and only after thirty days; using one counts, though it is but read."""
    make_package(tmp_path)
    caches = tmp_path / "caches"
    folders = {name: caches / name for name in ("solver-" + "0" * 16, "solver-" + "1" * 16, "solver-mine", "other")}
    for folder in folders.values():
        (folder / "inside").mkdir(parents=True)
        (folder / "inside" / "f.nbi").write_bytes(b"compiled")
    program = "import numba, groundsbot.offline.foundation.jit; print(numba.config.CACHE_DIR)"
    used = Path(output_of(program, tmp_path, NUMBA_CACHE_DIR=str(caches)).strip())
    day_s, now_s = 86_400.0, time.time()
    for folder, age in zip((*folders.values(), used), (31.0, 29.0, 31.0, 31.0, 31.0), strict=True):
        os.utime(folder, (now_s - age * day_s, now_s - age * day_s))
    (caches / ("solver-" + "2" * 16)).symlink_to(folders["other"])
    output_of(program, tmp_path, NUMBA_CACHE_DIR=str(caches))
    kept = sorted(path.name for path in caches.iterdir())
    assert kept == sorted(["solver-" + "1" * 16, "solver-" + "2" * 16, "solver-mine", "other", used.name])
    assert (folders["other"] / "inside" / "f.nbi").exists()
    assert used.stat().st_mtime > now_s - day_s
