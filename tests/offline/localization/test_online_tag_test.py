"""Which of the map's tags hold a robot online, of made squares in sigmas."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from groundsbot.offline.localization.online.information_root import OnlineRoot
from groundsbot.offline.localization.online.queries import LeaveOneOut
from groundsbot.offline.localization.online.tag_test import TagTest
from groundsbot.offline.measurements.tags import TagKey

TAGS = [TagKey("tag36h11", i) for i in range(6)]
HELD = {i: TAGS[i] for i in range(4)}
# Of 6 tags once in a hundred drives: 12.8 for one tag, 17.8 for two together.
FITS, CONTRADICTS = 5.0, 30.0


class _MadeRoot:
    """Tags 0 to 3 hold; 4 and 5 contradict, and each would fit if tag 0 did not hold."""

    def __init__(self, held: dict[int, float], together: float) -> None:
        self.prior = SimpleNamespace(n_tags=len(TAGS), n=20, held=HELD)
        self.step = np.zeros(23)
        self._held, self._together = held, together

    def squared_distance(self, tag: int) -> float:
        return self._held.get(tag, FITS)

    def leave_one_out(self, tag: int) -> LeaveOneOut:
        return LeaveOneOut(tag, np.zeros((23, 2)), np.zeros(2), np.eye(2))

    def loose_squared_distance(self, free: list[tuple[int, TagKey]], without: LeaveOneOut | None = None) -> float:
        if without is None or without.at != 0:
            return CONTRADICTS
        return FITS if len(free) == 1 else self._together


def _judge(held: dict[int, float], together: float) -> TagTest:
    judge = TagTest(dict(HELD), {tag: (TAGS[tag],) for tag in (4, 5)})
    for _ in judge.update(cast("OnlineRoot", _MadeRoot(held, together)), 100):
        pass
    return judge


@pytest.mark.parametrize(("together", "stay"), [(2.0 * FITS, [1, 2, 3]), (CONTRADICTS, [0, 1, 2, 3])])
def test_a_tag_is_let_go_for_others_that_fit_together_without_it(together: float, stay: list[int]) -> None:
    """Each alone is not enough: without a tag that stayed, a turn of the drive may explain either, but not both."""
    judge = _judge({}, together)
    assert sorted(judge.held) == stay
    assert (0 in judge.maybe) == (0 not in stay)


def test_the_tag_that_all_else_contradicts_most_is_let_go_first() -> None:
    judge = _judge({2: 20.0, 3: 25.0}, CONTRADICTS)
    assert sorted(judge.held) == [0, 1, 2]
    assert judge.maybe[3] == (TAGS[3],)
