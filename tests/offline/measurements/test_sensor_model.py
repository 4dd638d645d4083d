"""Detections become observations with consistent sigmas, or are left out with a warning."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS, EDGE_SHIFT, RANGE_OFFSET, TIME_OFFSET
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.calib.tags.edges import shift_edges
from groundsbot.offline.mapping.inputs import check_tag_sizes
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.sensor_model.corner_bias import refined_bias_px
from groundsbot.offline.measurements.sensor_model.observations import Observations
from groundsbot.offline.measurements.sensor_model.sensor_model import read_detections
from groundsbot.offline.measurements.tags import Detections, TagKey
from tests.support.data.drives import (
    CAMERA,
    FAMILY,
    MadeTag,
    make_drive,
    make_robot,
    make_run,
    seen_corners_px,
)

NOISE = NoiseParameters()
NO_TWIST = np.zeros((1000, 3))  # velocity of base at the keyframes
STILL = make_drive([0.0, 0.0, 0.0], [(0.0, 0.0, 1.0)])
ROBOT = make_robot(mount={"x_m": 0.2, "y_m": 0.05, "z_m": 0.4, "yaw_rad": 0.1, "pitch_rad": 0.05})
UPRIGHT = [MadeTag(i, (2.0 + 0.7 * i, 0.3 * i - 0.4, 0.4), np.pi + 0.2 * i - 0.3) for i in range(5)]


LEANING = MadeTag(0, (2.0, -0.4, 0.4), np.pi - 0.3, pitch_rad=-0.8)


def corners_of(tag: MadeTag) -> FloatArray:
    corners = seen_corners_px(tag, np.zeros(3), ROBOT, CAMERA)
    assert corners is not None
    return corners


def run_of(tags: list[MadeTag], robot: Robot = ROBOT) -> Run:
    return make_run([STILL.track], robot=robot, tags=[TagKey(FAMILY, tag.tag_id) for tag in tags])


def detections_of(corners_px: FloatArray, tag: list[int]) -> Detections:
    n = np.arange(len(tag), dtype=np.int64)
    return Detections(n, np.array(tag, dtype=np.int64), corners_px, np.zeros_like(n))


def read_many(
    tags: list[MadeTag], n: int = 40, sigma_px: float = 0.2, seed: int = 1, robot: Robot = ROBOT
) -> tuple[Observations, list[str]]:
    """Each tag from n keyframes."""
    noise = sigma_px * np.random.default_rng(seed).standard_normal((len(tags), n, 4, 2))
    corners_px = np.array([corners_of(tag) for tag in tags])[:, None] + noise
    detections = detections_of(corners_px.reshape(-1, 4, 2), np.repeat(np.arange(len(tags)), n).tolist())
    return read_detections(run_of(tags, robot), detections, np.tile(np.arange(n), len(tags)), NO_TWIST, NOISE)


def in_camera(tag: MadeTag) -> FloatArray:
    """True range and bearing about the camera's place and yaw."""
    dx, dy = tag.position_m[0] - 0.2, tag.position_m[1] - 0.05
    return np.array([np.hypot(dx, dy), np.arctan2(dy, dx) - 0.1])


def test_observations_are_about_the_camera_and_true() -> None:
    observations, warnings = read_many(UPRIGHT, n=1, sigma_px=0.0)
    assert warnings == []
    assert observations.polar.all()
    assert observations.in_camera.all()
    for observation, tag in zip(observations.value[np.argsort(observations.tag)], UPRIGHT, strict=True):
        np.testing.assert_allclose(observation, in_camera(tag), atol=1e-8)


def test_observations_are_free_of_bias_after_all_gates() -> None:
    """Gates may pick those that err one way: what is left of far and small tags is judged here."""
    tags = [
        MadeTag(i, (0.2 + distance_m, 0.05, 0.45), np.pi + np.radians(turned_deg), size_m=0.15)
        for i, (distance_m, turned_deg) in enumerate((d, a) for d in (1, 3, 5, 7, 8.5) for a in (0, 20, 40, 60))
    ]
    observations, warnings = read_many(tags, n=500)
    assert warnings == []
    for index, tag in enumerate(tags):
        mine = observations.where(observations.tag == index)
        assert len(mine) > 495
        sigma = np.sqrt(np.einsum("mii->mi", mine.covariance))
        bias = ((mine.value - in_camera(tag)) / sigma).mean(axis=0)
        # 0.15 is the bound for the truth; the mean of 500 is off by another 0.045 by chance.
        assert (np.abs(bias) < 0.15 + 0.045).all(), (tag, bias)


def test_refined_corners_are_less_certain_than_their_scatter_and_of_small_tags_by_far() -> None:
    """Of 60, 24 and 16 px, in front of the camera: the same noise model, and what they err by alike besides."""
    sides_px, noise = np.array([60.0, 24.0, 16.0]), NoiseParameters(sigma_corner_px=0.04)
    tags = [MadeTag(i, (0.2 + x_m, 0.05, 0.4), np.pi, size_m=0.15) for i, x_m in enumerate(900.0 * 0.15 / sides_px)]
    corners_px = np.array([corners_of(tag) for tag in tags])
    np.testing.assert_allclose(np.ptp(corners_px, axis=1), sides_px[:, None] * np.ones(2), rtol=0.03)
    run, detections = run_of(tags), detections_of(corners_px, [0, 1, 2])
    observations, _ = read_detections(replace(run, corners_refined=True), detections, np.arange(3), NO_TWIST, noise)
    beside = observations.parts.rest[:, 0, 0] / observations.parts.of(("sigma_corner_px",))[0, :, 0, 0]
    np.testing.assert_allclose(np.sqrt(beside), refined_bias_px(corners_px)[:, 0], rtol=1e-9)
    small_px = np.array([[0.0], [0.04], [0.2]])
    np.testing.assert_allclose(observations.corner_bias_px, np.hypot(small_px, [0.01, 0.02]), rtol=0.05)
    np.testing.assert_allclose(observations.parts.under(noise), observations.covariance, rtol=1e-12)
    as_detected, _ = read_detections(run, detections, np.arange(3), NO_TWIST, noise)
    assert not as_detected.corner_bias_px.any()
    assert (as_detected.covariance[:, 0, 0] < observations.covariance[:, 0, 0]).all()


def test_a_small_tag_is_left_out_rather_than_biased() -> None:
    """A tag of 5 cm at 8 m shows 5 px: its range would have no information."""
    tiny = [*UPRIGHT, MadeTag(9, (8.4, 0.5, 0.4), np.pi, size_m=0.04)]
    robot = make_robot(
        mount=ROBOT.mount.model_dump(), tags=[{"family": FAMILY, "default_size_m": 0.15, "sizes_m": {9: 0.04}}]
    )
    run = replace(run_of(tiny), robot=robot)
    corners_px = np.array([corners_of(tag) for tag in tiny])
    observations, warnings = read_detections(
        run, detections_of(corners_px, list(range(6))), np.arange(6), NO_TWIST, NOISE
    )
    assert sorted(observations.tag.tolist()) == [0, 1, 2, 3, 4]
    (warning,) = warnings
    assert "1 of 6 tag observations left out" in warning


def test_a_tilted_tag_is_reported_and_has_larger_sigmas() -> None:
    askew = MadeTag(7, (3.0, 0.4, 0.6), np.pi - 0.2, pitch_rad=-0.6)
    observations, warnings = read_many([*UPRIGHT, askew])
    (warning,) = warnings
    assert "tag 7 (tag36h11) is not mounted upright" in warning
    mine = observations.where(observations.tag == 5)
    assert len(mine) == 40
    sigma = np.sqrt(np.einsum("mii->mi", mine.covariance))
    assert (sigma[:, 0] > 0.05 * mine.value[:, 0]).all()
    assert (np.abs(mine.value - in_camera(askew)) < 3.0 * sigma).all()
    upright = observations.where(observations.tag != 5)
    assert (np.sqrt(upright.covariance[:, 0, 0]) < 0.03 * upright.value[:, 0]).all()


@pytest.mark.parametrize("turned_rad", [-0.016, 0.016])
def test_a_camera_pitched_by_two_of_its_sigmas_makes_no_tag_tilted(turned_rad: float) -> None:
    """Near tags seen from aside show it plainly; one that leans by 10 degrees besides is named, and it alone."""
    near = [MadeTag(i, (1.5, 0.25 * i - 0.3, 0.4), np.pi - (0.9 if i % 2 else -0.9)) for i in range(4)]
    leans = MadeTag(7, (1.7, 0.1, 0.7), np.pi - 0.9, pitch_rad=-np.radians(10.0))
    mount = ROBOT.mount.model_copy(update={"pitch_rad": ROBOT.mount.pitch_rad + turned_rad})
    for tags, said in ((near, 0), ([*near, leans], 1)):
        rng = np.random.default_rng(4)
        corners_px = np.repeat([corners_of(tag) for tag in tags], 40, axis=0)
        detections = detections_of(
            corners_px + 0.2 * rng.standard_normal(corners_px.shape), np.repeat(np.arange(len(tags)), 40).tolist()
        )
        run, keyframe = run_of(tags), np.tile(np.arange(40), len(tags))
        taken_for_exact = mount.model_copy(update={"pitch_rad_sigma": 1e-6, "roll_rad_sigma": 1e-6})
        for each, n in ((mount, said), (taken_for_exact, len(tags))):
            robot = run.robot.model_copy(update={"mount": each})
            _, warnings = read_detections(replace(run, robot=robot), detections, keyframe, NO_TWIST, NOISE)
            named = [warning for warning in warnings if "is not mounted upright" in warning]
            assert len(named) == n if n < 2 else len(named) > 1, named
            assert n != 1 or "tag 7" in named[0]


def test_where_all_tags_are_tilted_all_are_reported() -> None:
    """None of them shows how tags are mounted here: on a ceiling, say."""
    ceiling = [MadeTag(i, (2.4 + 0.4 * i, 0.3 * i - 0.4, 0.8), np.pi + 0.1 * i, pitch_rad=-0.9) for i in range(4)]
    observations, warnings = read_many(ceiling)
    assert len(warnings) == 4
    assert all("is not mounted upright" in warning for warning in warnings)
    assert (np.sqrt(observations.covariance[:, 0, 0]) > 0.05 * observations.value[:, 0]).all()


def test_a_detector_three_times_as_noisy_makes_no_tag_tilted() -> None:
    assert not any("upright" in warning for warning in read_many(UPRIGHT, n=30, sigma_px=0.6)[1])


def test_upright_tags_are_never_reported_as_tilted() -> None:
    for seed in range(20):
        assert read_many(UPRIGHT, n=15, seed=seed)[1] == []


def test_one_bad_picture_does_not_make_a_tag_tilted() -> None:
    """A corner put on something else beside the tag: that observation goes, the tag's others stay as they are."""
    n = 30
    rng = np.random.default_rng(2)
    corners_px = np.repeat(np.array([corners_of(tag) for tag in UPRIGHT]), n, axis=0)
    corners_px += 0.2 * rng.standard_normal(corners_px.shape)
    corners_px[7, 2] += [15.0, -9.0]
    detections = detections_of(corners_px, np.repeat(np.arange(5), n).tolist())
    observations, warnings = read_detections(run_of(UPRIGHT), detections, np.tile(np.arange(n), 5), NO_TWIST, NOISE)
    assert not any("upright" in warning for warning in warnings)
    assert len(observations) == 5 * n - 1
    assert 7 not in observations.keyframe[observations.tag == 0].tolist()


@pytest.mark.parametrize("corners", [np.nan, np.inf, 1e300, 0.0])
def test_corners_of_no_tag_are_left_out(corners: float) -> None:
    n = 10
    corners_px = np.repeat(np.array([corners_of(tag) for tag in UPRIGHT]), n, axis=0)
    corners_px[3] = corners
    detections = detections_of(corners_px, np.repeat(np.arange(5), n).tolist())
    observations, _ = read_detections(run_of(UPRIGHT), detections, np.tile(np.arange(n), 5), NO_TWIST, NOISE)
    assert len(observations) == 5 * n - 1
    assert np.isfinite(observations.value).all()
    assert np.isfinite(observations.covariance).all()


def test_one_bad_picture_does_not_take_its_standing_pose_along() -> None:
    """Pictures of one standing pose are averaged: a corner that is no number must not spoil the others."""
    corners_px = np.repeat(np.array([corners_of(tag) for tag in UPRIGHT]), 6, axis=0)
    corners_px[3, 1, 0] = np.nan
    detections = detections_of(corners_px, np.repeat(np.arange(5), 6).tolist())
    observations, _ = read_detections(run_of(UPRIGHT), detections, np.zeros(30, dtype=np.int64), NO_TWIST, NOISE)
    assert len(observations) == 5
    np.testing.assert_allclose(observations.value[observations.tag == 0][0], in_camera(UPRIGHT[0]), atol=1e-7)


def test_a_standing_pose_gives_one_observation_with_the_sigma_of_one_picture() -> None:
    tag = UPRIGHT[2]
    offset = 0.3 * np.random.default_rng(0).standard_normal((50, 4, 2))
    offset -= offset.mean(axis=0)
    detections = detections_of(corners_of(tag) + offset, [0] * 50)
    many, _ = read_detections(run_of([tag]), detections, np.full(50, 4), NO_TWIST, NOISE)
    one, _ = read_detections(run_of([tag]), detections_of(corners_of(tag)[None], [0]), np.array([4]), NO_TWIST, NOISE)
    assert len(many) == 1
    assert many.keyframe.tolist() == [4]
    np.testing.assert_allclose(many.value, one.value, atol=1e-9)
    np.testing.assert_allclose(many.covariance, one.covariance, rtol=1e-6)


def test_two_tags_with_one_id_in_one_picture_are_two_observations() -> None:
    one, other = corners_of(UPRIGHT[1]), corners_of(UPRIGHT[4])
    # From one standing pose: both, both in the other order, one only, and one that the detector found twice.
    corners_px = np.array([one, other, other, one, other, one, one + 0.5])
    stamps_ns = np.array([0, 0, 1, 1, 2, 3, 3])
    detections = Detections(stamps_ns, np.zeros(7, dtype=np.int64), corners_px, np.zeros(7, dtype=np.int64))
    observations, _ = read_detections(run_of(UPRIGHT), detections, np.full(7, 5), NO_TWIST, NOISE)
    assert observations.keyframe.tolist() == [5, 5]
    assert observations.tag.tolist() == [0, 0]
    np.testing.assert_allclose(observations.value, [in_camera(UPRIGHT[1]), in_camera(UPRIGHT[4])], atol=0.01)


def test_a_tag_in_the_lens_is_a_phantom() -> None:
    close = MadeTag(3, (0.2 + 0.08, 0.058, 0.396), np.pi + 0.1, size_m=0.03)
    robot = make_robot(mount=ROBOT.mount.model_dump(), tags=[{"family": FAMILY, "default_size_m": 0.03}])
    run = replace(run_of([close]), robot=robot)
    observations, _ = read_detections(run, detections_of(corners_of(close)[None], [0]), np.array([0]), NO_TWIST, NOISE)
    assert len(observations) == 0


def test_nothing_seen_is_no_observation() -> None:
    observations, warnings = read_detections(
        run_of([]), detections_of(np.zeros((0, 4, 2)), []), np.zeros(0, int), NO_TWIST, NOISE
    )
    assert (len(observations), warnings) == (0, [])


def run_with_size(size_m: float | None, name: str = "carl", sizes_m: dict[int, float] | None = None) -> Run:
    batch: dict[str, object] = {"family": FAMILY, "sizes_m": sizes_m or {99: 0.1}}
    if size_m is not None:
        batch["default_size_m"] = size_m
    detections = detections_of(np.zeros((1, 4, 2)), [0])
    run = make_run([STILL.track], robot=make_robot(name, tags=[batch]), tags=[TagKey(FAMILY, 4)], detections=detections)
    return replace(run, log=Path("logs") / name)


def test_logs_that_disagree_about_a_size_are_refused() -> None:
    with pytest.raises(GroundsbotError) as caught:
        check_tag_sizes([run_with_size(0.15), run_with_size(0.16, "dora")])
    for part in ("logs/dora", "tag 4", "0.16", "0.15", "carl", "--robot"):
        assert part in str(caught.value)


def test_sizes_that_agree_or_are_of_tags_not_seen_are_no_matter() -> None:
    check_tag_sizes([run_with_size(0.15), run_with_size(0.15, "dora"), run_with_size(0.15, "eve", {7: 0.3})])


def test_what_roll_pitch_and_late_stamps_do_to_an_observation() -> None:
    """By moving the robot on and by observation with another mount, both by hand."""
    tag, speed_m_s, turning_rad_s = UPRIGHT[0], 0.4, -0.7
    run = run_of([tag])
    twist = np.array([[speed_m_s, 0.0, turning_rad_s]])

    def read(robot: Robot, T_map_base: FloatArray) -> Observations:
        corners_px = seen_corners_px(tag, T_map_base, run.robot, CAMERA)
        assert corners_px is not None
        one = detections_of(corners_px[None], [0])
        return read_detections(replace(run, robot=robot), one, np.array([0]), twist, NOISE)[0]

    here = read(run.robot, np.zeros(3))
    for k, name in enumerate(("roll_rad", "pitch_rad")):
        mount = run.robot.mount.model_copy(update={name: getattr(run.robot.mount, name) + 1e-5})
        other = read(run.robot.model_copy(update={"mount": mount}), np.zeros(3))
        np.testing.assert_allclose(here.by_camera[0, :, k], (other.value - here.value)[0] / 1e-5, rtol=1e-2, atol=1e-3)
    later = read(run.robot, se2.exp(1e-4 * np.array([speed_m_s, 0.0, turning_rad_s])))
    np.testing.assert_allclose(
        here.by_camera[0, :, CAMERA_PARAMETERS.index(TIME_OFFSET)],
        (later.value - here.value)[0] / 1e-4,
        rtol=1e-2,
        atol=1e-3,
    )


@pytest.mark.parametrize(("tag", "rtol"), [(UPRIGHT[0], 1e-4), (LEANING, 0.2)], ids=["upright", "askew"])
def test_what_sides_seen_too_far_out_do_to_an_observation(tag: MadeTag, rtol: float) -> None:
    """As the observation of corrected corners; for a tilted tag only the range, which is poor."""
    run = run_of([tag])
    corners_px = corners_of(tag)

    def read(too_far_out_px: float) -> Observations:
        seen = np.tile(shift_edges(corners_px, -too_far_out_px), (3, 1, 1))
        detections = detections_of(seen, [0, 0, 0])
        return read_detections(run, detections, np.arange(3), np.zeros((3, 3)), NOISE)[0]

    here = read(0.0)
    assert len(here) == 3
    by_hand = (read(1e-3).value - read(-1e-3).value)[0] / 2e-3
    assert by_hand[0] > 0.0
    by_edge = here.by_camera[0, :, CAMERA_PARAMETERS.index(EDGE_SHIFT)]
    np.testing.assert_allclose(by_edge[0], by_hand[0], rtol=rtol)
    np.testing.assert_allclose(by_edge[1], by_hand[1], atol=1e-6 if tag is UPRIGHT[0] else 1e-3)


def test_an_offset_of_ranges_is_taken_off_and_its_derivative_is_that() -> None:
    observations, _ = read_many(UPRIGHT, n=1)
    assert observations.by_camera.shape == (5, 2, len(CAMERA_PARAMETERS))
    np.testing.assert_array_equal(observations.by_camera[..., CAMERA_PARAMETERS.index(RANGE_OFFSET)], [[-1.0, 0.0]] * 5)
    shorter, _ = read_many(UPRIGHT, n=1, robot=ROBOT.model_copy(update={"range_offset_m": 0.125}))
    np.testing.assert_allclose(shorter.value - observations.value, [[-0.125, 0.0]] * 5, atol=1e-12)
