"""Compiled code also where nothing may be written."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from offline import jit
from offline.jit import COMPILING, compilation_announced, jitted


def test_compiles_where_no_cache_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    real = numba.njit

    def refusing(*functions: Any, cache: bool = False, **options: Any) -> Any:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return real(*functions, **options)

    monkeypatch.setattr(numba, "njit", refusing)

    def one_more(x: float) -> float:
        return x + 1.0

    assert jitted(one_more)(1.0) == 2.0


def test_compiling_is_told_of_once() -> None:
    told: list[str] = []

    def one_more(x: float | np.float32) -> float:
        return float(x + 1.0)

    compiled: Any = numba.njit(one_more)  # without a cache: it must compile each time
    with compilation_announced(told.append):
        assert not told
        assert (compiled(1.0), compiled(1)) == (2.0, 2)
    assert compiled(np.float32(1.0)) == 2.0  # compiles once more, after the block
    assert told == [COMPILING]


def test_an_edit_of_any_kernel_leaves_the_old_cache_alone(tmp_path: Path) -> None:
    """A caller in one file must not be loaded with what a callee in another used to be."""
    package = tmp_path / "offline"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "jit.py").write_text(Path(jit.__file__).read_text())
    callee, caller = package / "callee.py", package / "caller.py"
    caller.write_text(
        "from offline.callee import f\nfrom offline.jit import jitted\n@jitted\ndef g(x):\n    return f(x)\n"
    )
    found = []
    for plus in ("1.0", "2.0"):
        callee.write_text(f"from offline.jit import jitted\n@jitted\ndef f(x):\n    return x + {plus}\n")
        command = [sys.executable, "-c", "from offline.caller import g; print(g(1.0))"]
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        found.append(float(done.stdout))
    assert found == [2.0, 3.0]
