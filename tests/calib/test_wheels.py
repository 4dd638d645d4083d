"""Motion on exact arcs and its derivatives."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2, wheels

STEP = 1e-6
TURNS = np.array([0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.5 - 1e-9, 0.5 + 1e-9, np.pi - 1e-9, np.pi, np.pi + 1e-9, 5.0])


@st.composite
def steps(draw: st.DrawFn) -> tuple[FloatArray, FloatArray, float]:
    """Left and right advances and a track: straight, turning ever so little, and round to beyond half a turn."""
    track = draw(st.floats(0.1, 1.0))
    drawn = draw(arrays(np.float64, 3, elements=st.floats(-6.0, 6.0)))
    turns = np.concatenate([TURNS, -TURNS, drawn])
    distance = draw(arrays(np.float64, len(turns), elements=st.floats(-2.0, 2.0)))
    return distance - 0.5 * track * turns, distance + 0.5 * track * turns, track


def test_quarter_circle_by_hand() -> None:
    # Radius 1 m to the left, track 0.5 m: the wheels roll on 0.75 m and 1.25 m, the base ends at (1, 1) facing left.
    motion = wheels.advance(0.75 * np.pi / 2, 1.25 * np.pi / 2, 0.5)
    np.testing.assert_allclose(motion, [1.0, 1.0, np.pi / 2], atol=1e-15)


@given(steps())
def test_an_arc_is_the_exponential_of_a_constant_twist(step: tuple[FloatArray, FloatArray, float]) -> None:
    left, right, track = step
    motion = wheels.advance(left, right, track)
    twist = np.stack([0.5 * (left + right), np.zeros_like(left), (right - left) / track], axis=-1)
    np.testing.assert_allclose(motion[..., :2], se2.exp(twist)[..., :2], atol=1e-12)
    np.testing.assert_array_equal(motion[..., 2], twist[..., 2])


@given(steps())
def test_jacobians_agree_with_finite_differences(step: tuple[FloatArray, FloatArray, float]) -> None:
    left, right, track = step
    motion, by_wheels, by_track = wheels.advance_with_jacobians(left, right, track)
    np.testing.assert_array_equal(motion, wheels.advance(left, right, track))

    def difference(d_left: float, d_right: float, d_track: float) -> FloatArray:
        ahead = wheels.advance(left + d_left, right + d_right, track + d_track)
        behind = wheels.advance(left - d_left, right - d_right, track - d_track)
        return (ahead - behind) / (2 * STEP)

    np.testing.assert_allclose(by_wheels[..., 0], difference(STEP, 0, 0), atol=1e-7)
    np.testing.assert_allclose(by_wheels[..., 1], difference(0, STEP, 0), atol=1e-7)
    np.testing.assert_allclose(by_track, difference(0, 0, STEP), atol=1e-5, rtol=1e-6)


def test_wheels_and_track_broadcast() -> None:
    motion, by_wheels, by_track = wheels.advance_with_jacobians(np.zeros((4, 1)), np.ones(3), 0.5)
    assert (motion.shape, by_wheels.shape, by_track.shape) == ((4, 3, 3), (4, 3, 3, 2), (4, 3, 3))
