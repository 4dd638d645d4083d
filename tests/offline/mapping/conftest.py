"""What several tests of mapping share."""

import pytest

from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from tests.offline.mapping.framed_maps import NOISE, run_of


@pytest.fixture(scope="module")
def known() -> MapResult:
    return build_map([run_of("a"), run_of("b")], NOISE)
