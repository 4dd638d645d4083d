"""The Cramer-Rao bound of `tests.benchmarks.accuracy.cramer_rao` on cases of two poses that are worked by hand.

A camera of focal length f looks level at an upright tag of side 2h straight ahead, r away and as high as itself. With
the corners at (+-h, +-h) and a = (f / r)^2, to first order in what the tag is moved by (x sideways, z ahead) and turned
by (b about its vertical), the pixels of a corner at (X, Y) move by

    du = (f / r) x + (f / r^2) X^2 b - (f / r^2) X z,        dv = (f / r^2) X Y b - (f / r^2) Y z,

so that over the four corners, in units of sigma_px^2, the information is I_zz = 8 a h^2 / r^2 with nothing beside it,
I_xx = 4 a, I_bb = 8 a h^4 / r^2, I_xb = 4 a h^2 / r. Hence var z = r^4 / (8 f^2 h^2), var x = 1 / (2 a),
var b = r^2 / (4 a h^4) and cov(x, b) = -r / (4 a h^2), each times sigma_px^2.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.fixtures.worlds.world import load_world
from tests.benchmarks.accuracy.cramer_rao import cramer_rao
from tests.benchmarks.accuracy.cramer_rao_gyro import GyroNoise, TrueGyro
from tests.benchmarks.accuracy.cramer_rao_measured import (
    CALIBRATION,
    Noise,
    TrueRun,
    TrueTags,
    motion_covariance,
    motion_jacobian,
)
from tests.benchmarks.accuracy.cramer_rao_world import bound_of
from tests.support.paths import ROOT

FOCAL_PX, HALF_M, HEIGHT_M, SIGMA_PX, FAR_M, WAY_M, SPEED_M_S, STEPS = 1000.0, 0.075, 0.4, 0.2, 4.0, 1.5, 0.8, 100
NEAR_M = FAR_M - WAY_M
NOISE = Noise(0.01, 0.002, 0.01, 0.02, SIGMA_PX)
TAG = TrueTags(
    place_m=np.array([[FAR_M, 0.0, HEIGHT_M]]),
    rotation=np.array([[[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]),  # its face looks back along x
    side_m=np.array([2.0 * HALF_M]),
    batch=np.array([0]),
    batch_sigma=np.array([0.0]),
)


def ahead_variance(range_m: float) -> float:
    return SIGMA_PX**2 * range_m**4 / (8.0 * FOCAL_PX**2 * HALF_M**2)


def straight(begin_m: float, way_m: float, **sigma: float) -> TrueRun:
    """Drives along x, with a picture of the tag at its start and, where it drives at all, at its end."""
    moments = np.linspace(0.0, way_m, STEPS + 1 if way_m else 1)
    pose = np.unique([0, len(moments) - 1])
    return TrueRun(
        place=(begin_m + moments).astype(np.complex128),
        heading_rad=np.zeros(len(moments)),
        rolled_m=np.repeat(np.diff(moments)[:, None], 2, axis=1),
        pose=pose,
        picture_pose=np.arange(len(pose)),
        twist=np.tile([SPEED_M_S, 0.0], (len(pose), 1)),
        picture=np.arange(len(pose)),
        tag=np.zeros(len(pose), dtype=np.int64),
        row_s=np.zeros((len(pose), 4)),
        camera=CameraModel("c", 1280, 720, FOCAL_PX, FOCAL_PX, 640.0, 360.0, "plumb_bob", (0.0,) * 5),
        track_m=0.5,
        mount=np.array([0.0, 0.0, HEIGHT_M, 0.0, 0.0, 0.0]),
        sigma=np.array([sigma.get(name, 0.0) for name in CALIBRATION]),
    )


def ahead_of_two_looks(odometry: float = 0.0, both: float = 0.0) -> float:
    """Variance of where the tag is along the way, its first look from a known pose.

    Args:
        odometry: variance of the way between the two looks, beside the wheels' noise.
        both: what the two looks err by together.
    """
    first = ahead_variance(FAR_M)
    second = ahead_variance(NEAR_M) + NOISE.distance_m_per_sqrt_m**2 * WAY_M + odometry
    return 1.0 / (1.0 / first + 1.0 / second) + both


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [
        ({}, ahead_of_two_looks()),
        # Two wheels, each off by its own share, err by half the sum.
        ({"radius_left": 0.02, "radius_right": 0.02}, ahead_of_two_looks(odometry=0.5 * (0.02 * WAY_M) ** 2)),
        ({"mount_x_m": 0.01, "mount_y_m": 0.01}, ahead_of_two_looks(both=0.01**2)),
        ({"time_offset_s": 0.02}, ahead_of_two_looks(both=(0.02 * SPEED_M_S) ** 2)),
    ],
)
def test_a_tag_seen_from_two_poses_on_the_way_to_it(sigma: dict[str, float], expected: float) -> None:
    bound = cramer_rao([straight(0.0, WAY_M, **sigma)], TAG, NOISE)
    assert bound.tags[0, 0] == pytest.approx(expected, rel=1e-4)


def test_a_base_that_nods_moves_its_camera_to_and_fro() -> None:
    """By the angle p times its height. The height of one tag in both pictures gives far p_far = near p_near."""
    sigma = 0.02
    along = HEIGHT_M * sigma / np.hypot(FAR_M, NEAR_M) * np.array([NEAR_M, FAR_M])
    second = ahead_variance(NEAR_M) + NOISE.distance_m_per_sqrt_m**2 * WAY_M
    covariance = np.diag([ahead_variance(FAR_M), second]) + np.outer(along, along)
    bound = cramer_rao([straight(0.0, WAY_M)], TAG, replace(NOISE, tilt_rad=sigma))
    assert bound.tags[0, 0] == pytest.approx(1.0 / np.linalg.inv(covariance).sum(), rel=1e-3)


def test_what_focal_length_and_print_err_by_goes_with_the_range() -> None:
    """Two pictures at a known distance give the scale, so of two unknown scales only the sum is determined."""
    sigma, v_far, v_near = 0.03, ahead_variance(FAR_M), ahead_variance(NEAR_M)
    v_near += NOISE.distance_m_per_sqrt_m**2 * WAY_M
    information = np.array(
        [[1 / v_far + 1 / v_near, FAR_M / v_far + NEAR_M / v_near], [0.0, FAR_M**2 / v_far + NEAR_M**2 / v_near]]
    )
    information[1, 0] = information[0, 1]
    for prior, run, tags in (
        (sigma, straight(0.0, WAY_M, focal_length=sigma), TAG),
        (sigma, straight(0.0, WAY_M), replace(TAG, batch_sigma=np.array([sigma]))),
        (np.hypot(sigma, sigma), straight(0.0, WAY_M, focal_length=sigma), replace(TAG, batch_sigma=np.array([sigma]))),
    ):
        expected = np.linalg.inv(information + np.diag([0.0, prior**-2]))[0, 0]
        assert cramer_rao([run], tags, NOISE).tags[0, 0] == pytest.approx(expected, rel=1e-3)


def test_two_starts_joined_by_one_tag() -> None:
    """Sideways the second start depends on the tag's bearing from the first start, and on that from the second."""
    a_far, a_near = (FOCAL_PX / FAR_M) ** 2, (FOCAL_PX / NEAR_M) ** 2

    def sideways(range_m: float, a: float) -> float:
        """Of the place `NEAR_M` before the face of a tag that is seen from `range_m`."""
        terms = 1 / (2 * a) + NEAR_M**2 * range_m**2 / (4 * a * HALF_M**4) + 2 * NEAR_M * range_m / (4 * a * HALF_M**2)
        return SIGMA_PX**2 * terms

    bound = cramer_rao([straight(0.0, 0.0), straight(WAY_M, 0.0)], TAG, NOISE)
    expected: FloatArray = np.diag(
        [ahead_variance(FAR_M) + ahead_variance(NEAR_M), sideways(FAR_M, a_far) + sideways(NEAR_M, a_near)]
    )
    np.testing.assert_allclose(bound.starts[0], expected, rtol=1e-4, atol=1e-9)
    assert bound.start_to_start_m == pytest.approx(np.sqrt(np.trace(expected)), rel=1e-4)
    assert bound.start_distances_m[0] == pytest.approx(np.sqrt(expected[0, 0]), rel=1e-4)


def quarter_circle(radius_m: float, steps: int) -> TrueRun:
    heading = np.linspace(0.0, 0.5 * np.pi, steps + 1)
    return replace(
        straight(0.0, 0.0),
        place=radius_m * (np.sin(heading) + 1j * (1.0 - np.cos(heading))),
        heading_rad=heading,
        rolled_m=np.outer(np.diff(heading), [radius_m - 0.25, radius_m + 0.25]),
        pose=np.array([0, steps]),
    )


def test_a_quarter_circle() -> None:
    """Radius R: a share more of both radii goes on along the arc, one of the track makes the circle that much wider.

    A heading that is off at an angle p before the end moves the end by as much times the chord 2 R sin(p / 2), squares
    of which add up to 2 R^3 (a - sin a) over the arc a.
    """
    radius_m, angle, sigma = 2.0, 0.5 * np.pi, 0.003
    run = quarter_circle(radius_m, 2000)
    (by,) = motion_jacobian(run, NOISE)
    np.testing.assert_allclose(-by[:, 6] - by[:, 7], [radius_m * angle, 0.0, angle], atol=1e-6)
    np.testing.assert_allclose(-by[:, 8], [radius_m * (1.0 - angle), -radius_m, -angle], atol=1e-6)
    (covariance,) = motion_covariance(run, Noise(0.0, 0.0, sigma, 0.0, SIGMA_PX))
    assert covariance[2, 2] == pytest.approx(sigma**2 * radius_m * angle, rel=1e-4)
    expected = 2.0 * sigma**2 * radius_m**3 * (angle - np.sin(angle))
    assert np.trace(covariance[:2, :2]) == pytest.approx(expected, rel=5e-3)


TURN_NOISE = Noise(0.0, 0.0, 0.01, 0.0, 1e-3)


def drive_to_a_tag() -> tuple[TrueRun, TrueTags]:
    """A quarter circle with one picture at its end, of a tag straight ahead; the corners all but exact."""
    turned = Rotation.from_euler("z", 0.5 * np.pi).as_matrix()
    tag = replace(TAG, place_m=np.array([[2.0, 2.0 + FAR_M, HEIGHT_M]]), rotation=turned @ TAG.rotation)
    one = np.array([0])
    return replace(quarter_circle(2.0, 400), picture_pose=np.array([1]), picture=one, tag=one), tag


@pytest.mark.parametrize("gap", [False, True])
@pytest.mark.parametrize(
    ("gyro", "track"),
    [
        (GyroNoise(0.004, 0.0, 0.0, 0.0), 0.0),
        (GyroNoise(0.004, 0.0, 0.02, 0.0), 0.0),
        (GyroNoise(0.002, 0.004, 0.02, 0.0), 0.0),
        (GyroNoise(0.0005, 0.0, 0.0, 0.05), 0.0),
        (GyroNoise(0.002, 0.004, 0.02, 0.05), 0.03),
    ],
    ids=["noise", "bias", "walk", "scale", "all"],
)
def test_wheels_and_gyro_determine_a_tag_at_the_end_of_a_turn(gyro: GyroNoise, track: float, gap: bool) -> None:
    """Against Gaussian conditioning, dense: of the turn in each step on all that the gyro measured of it.

    What the turn is off by in a step moves the tag across the line to it from there.
    """
    run, tag = drive_to_a_tag()
    sigma = np.where(np.array(CALIBRATION) == "track", track, 0.0)
    time_s = np.linspace(0.0, 8.0, len(run.place))
    is_known = np.ones(len(time_s) - 1, dtype=np.bool_)
    is_known[150:250] = not gap
    step_s, turn_rad = np.diff(time_s), np.diff(run.heading_rad)
    middle_s = 0.5 * (time_s[1:] + time_s[:-1])
    turned: FloatArray = TURN_NOISE.heading_rad_per_sqrt_m**2 * np.diag(run.rolled_m.mean(axis=1))
    turned += track**2 * np.outer(turn_rad, turn_rad)
    bias = gyro.bias_rad_s**2 + gyro.bias_walk_rad_s_per_sqrt_s**2 * np.minimum.outer(middle_s, middle_s)
    measured = turned + np.diag(gyro.noise_rad_per_sqrt_s**2 * step_s) + bias * np.outer(step_s, step_s)
    measured += gyro.scale**2 * np.outer(turn_rad, turn_rad)
    gain = np.linalg.solve(measured[np.ix_(is_known, is_known)], turned[is_known]).T
    remaining = turned - gain @ turned[is_known]
    to_tag = complex(*tag.place_m[0, :2]) - 0.5 * (run.place[1:] + run.place[:-1])
    across = np.stack([-to_tag.imag, to_tag.real])
    bound = cramer_rao([replace(run, sigma=sigma, gyro=TrueGyro(gyro, time_s, is_known))], tag, TURN_NOISE)
    expected = across @ remaining @ across.T
    np.testing.assert_allclose(bound.tags, expected, rtol=5e-3, atol=2e-3 * np.abs(expected).max())


def test_a_gyro_of_much_noise_says_nothing_and_one_of_none_all_of_the_heading() -> None:
    run, tag = drive_to_a_tag()
    time_s = np.linspace(0.0, 8.0, len(run.place))
    is_known = np.ones(len(time_s) - 1, dtype=np.bool_)
    for sigma, heading, scale in ((1e3, TURN_NOISE.heading_rad_per_sqrt_m, 0.05), (1e-7, 0.0, 0.0)):
        gyro = TrueGyro(GyroNoise(sigma, 0.0, scale, scale), time_s, is_known)
        bound = cramer_rao([replace(run, gyro=gyro)], tag, TURN_NOISE)
        without = cramer_rao([run], tag, replace(TURN_NOISE, heading_rad_per_sqrt_m=heading))
        np.testing.assert_allclose(bound.tags, without.tags, rtol=1e-3, atol=1e-9)


def test_nothing_of_the_estimate_is_in_it() -> None:
    for path in (ROOT / "tests" / "benchmarks" / "accuracy").glob("cramer_rao*.py"):
        imported = [line for line in path.read_text().splitlines() if line.startswith(("from ", "import "))]
        assert len(imported) > 3
        assert not [line for line in imported if "offline" in line]


def test_in_a_room_a_lens_of_unknown_focal_length_costs_accuracy() -> None:
    room = load_world("room")
    known, unknown = (bound_of(room, 0, exact_calibration=False, sigma_focal_length=each) for each in (0.0, 0.01))
    assert unknown.tags_m > 1.01 * known.tags_m
    assert np.linalg.eigvalsh(unknown.tags - known.tags).min() > -1e-9
    assert unknown.start_to_start_m > known.start_to_start_m
    assert list(known.seen) == list(range(8))


def test_in_a_room_a_gyro_adds_more_information_the_longer_it_measures() -> None:
    room, gyro = load_world("room"), GyroNoise(2.6e-4, 8e-7, 0.02, 0.01)
    none, all_gaps, gaps, good = (
        bound_of(room, 0, exact_calibration=False, gyro=each, gyro_gaps=np.array(at)).tags_m
        for each, at in ((None, []), (gyro, np.linspace(0.0, 1.0, 1000)), (gyro, [0.3, 0.6]), (gyro, []))
    )
    assert none == pytest.approx(all_gaps, rel=1e-6)
    assert none > 1.01 * gaps > 1.01 * good


def test_wheels_that_measure_no_turns_cost_little_beside_a_good_gyro() -> None:
    room, good = load_world("room"), GyroNoise(2.6e-4, 8e-7, 0.02, 0.01)
    times = []
    for gyro in (good, replace(good, noise_rad_per_sqrt_s=2.6e-2)):
        turning, alone = (
            bound_of(room, 0, exact_calibration=False, gyro=gyro, wheels_turn=each).tags_m for each in (True, False)
        )
        times.append(alone / turning)
    assert 1.0 < times[0] < 1.02
    assert times[1] > 2.0
