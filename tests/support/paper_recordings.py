"""Path of the paper's own recordings, if they are there."""

import pytest

from tests.support.paths import SHARED

# Beside the project: they carry no licence, so they are not part of it.
RECORDINGS = SHARED / "data" / "nsh_first_floor"

needs_recordings = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the paper's recordings carry no licence and are not in ../shared/data"
)
