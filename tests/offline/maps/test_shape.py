"""The shape of a map: sigmas of tags relative to each other, in any frame."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.offline.maps.result import Component
from groundsbot.offline.maps.shape import shape_of
from tests.support.data.maps import make_component


def _with_covariance(component: Component, own_m2: float, turn_rad2: float, shift_m2: float) -> Component:
    """Tags with errors of their own, turned as a whole about the frame's origin, and shifted."""
    n_starts, n = 3 * len(component.runs), len(component.tags)
    places = np.array([tag.position_m for tag in component.tags])
    turned = np.stack([-places[:, 1], places[:, 0]], axis=-1).reshape(-1)
    shift = np.tile(np.eye(2), (n, 1))
    joint = np.zeros((n_starts + 2 * n, n_starts + 2 * n))
    joint[n_starts:, n_starts:] = (
        own_m2 * np.eye(2 * n) + turn_rad2 * np.outer(turned, turned) + shift_m2 * shift @ shift.T
    )
    return replace(component, joint_covariance=joint)


def test_what_turns_and_shifts_all_tags_is_not_in_the_shape() -> None:
    component = make_component()
    rigid = shape_of(_with_covariance(component, 0.0, 0.04**2, 0.3**2))
    assert rigid is not None
    np.testing.assert_allclose(rigid.tag_covariances, 0.0, atol=1e-12)
    assert rigid.heading_sigma_rad == pytest.approx(0.04)
    both = shape_of(_with_covariance(component, 0.01**2, 0.04**2, 0.3**2))
    alone = shape_of(_with_covariance(component, 0.01**2, 0.0, 0.0))
    assert both is not None
    assert alone is not None
    np.testing.assert_allclose(both.tag_covariances, alone.tag_covariances, atol=1e-12)
    # Of 2 T errors of their own, three go into the datum.
    n = len(component.tags)
    assert np.trace(alone.tag_covariances, axis1=1, axis2=2).sum() == pytest.approx(0.01**2 * (2 * n - 3))


def test_one_tag_and_unknown_covariances_have_no_shape() -> None:
    component = make_component()
    one = replace(component, tags=component.tags[:1], joint_covariance=np.eye(3 * len(component.runs) + 2))
    assert shape_of(one) is None
    assert shape_of(replace(component, joint_covariance=np.nan * component.joint_covariance)) is None
