"""A drive in a finished map, localised online."""

import pytest

from groundsbot.offline.localization.online.localizer import OnlineLocalizer
from tests.benchmarks.accuracy.localize_study import Scene, filter_online, make_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = make_scene(4)
    assert made is not None
    return made


@pytest.fixture(scope="module")
def online(scene: Scene) -> OnlineLocalizer:
    return filter_online(scene)[0]
