"""Where the paper's own recordings lie, if they do."""

from pathlib import Path

import pytest

# Beside the project: they carry no licence, so they are not part of it.
RECORDINGS = Path(__file__).parents[2] / "shared" / "data" / "nsh_first_floor"

needs_recordings = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the paper's recordings carry no licence and are not in ../shared/data"
)
