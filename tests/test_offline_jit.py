"""Compiled code also where nothing may be written."""

from typing import Any

import numba
import pytest

from offline.jit import jitted


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
