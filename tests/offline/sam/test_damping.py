"""Levenberg-Marquardt's rule."""

from itertools import pairwise

import pytest

from groundsbot.offline.sam.damping import Damping


def test_steps_are_gauss_newtons_until_one_is_rejected() -> None:
    damping = Damping()
    damping.accept_step(1.0)
    assert damping.share == 0.0
    assert damping.is_least
    damping.reject_step()
    assert damping.share == 1e-12
    assert not damping.is_least


def test_it_grows_faster_each_time_in_a_row_until_no_step_will_do() -> None:
    damping = Damping()
    shares = []
    while not damping.is_exhausted:
        damping.reject_step()
        shares.append(damping.share)
    assert len(shares) == 13
    assert [after / before for before, after in pairwise(shares)] == pytest.approx([4.0 * 2.0**i for i in range(12)])


def test_good_steps_lower_it_to_none_and_poor_ones_raise_it() -> None:
    damping = Damping()
    for _ in range(4):
        damping.reject_step()
    before = damping.share
    damping.accept_step(0.0)  # promised much, brought nothing
    assert damping.share == pytest.approx(2.0 * before)
    for _ in range(10):
        damping.accept_step(1.0)
    assert damping.share == 0.0
    damping.reject_step()
    assert damping.share == 1e-12
    assert not damping.is_exhausted


def test_what_rounding_needs_stays() -> None:
    damping = Damping()
    damping.require(1e-10)
    damping.accept_step(1.0)
    assert damping.share == 1e-10
    assert damping.is_least
    damping.reject_step()
    assert damping.share == pytest.approx(2e-10)
