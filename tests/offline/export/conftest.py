"""A small map of two drives, for all tests of exports."""

from pathlib import Path

import pytest

from tests.support.data.exported_map import make_small_map


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_small_map(tmp_path_factory.mktemp("small"))
