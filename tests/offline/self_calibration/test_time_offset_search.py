"""A late camera is found over two seconds without a map, and none is where drives do not determine it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry.se2 import wrap_angle
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.simulate import simulate
from groundsbot.offline.measurements.run import Run, load_run
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.self_calibration.pass_model import PARAMETERS, linearise, tag_positions
from groundsbot.offline.self_calibration.passes import WheelAxis, find_passes
from groundsbot.offline.self_calibration.start_values import estimate_start_values
from groundsbot.offline.self_calibration.time_offset_search import TimeOffsetSearch, search_time_offset
from groundsbot.onboard.log.reading.reader import find_logs
from tests.support.data.drives import FAMILY, S, make_drive, make_positions, make_robot, make_run

ROUND = [(0.5, 0.5, 5.0), (0.1, 0.5, 1.9), (0.4, 0.4, 3.0), (0.6, 0.45, 5.0), (-0.2, 0.2, 2.0), (0.5, 0.3, 2.0)]
DRIVE = tuple(6 * ROUND)
TO_AND_FRO = [*ROUND, *((-left, -right, s) for left, right, s in reversed(ROUND))]
TAGS_M = np.random.default_rng(3).uniform(-6.0, 10.0, (40, 2))
FIELD_RAD = 0.9
FARTHEST_M = 5.0


def position_run(
    late_s: float = 0.0,
    legs: Sequence[tuple[float, float, float]] = DRIVE,
    *,
    seed: int = 0,
    in_camera: bool = False,
    wrong_ids: float = 0.0,
    heading_rad_per_sqrt_m: float = 0.0,
    lasting: float = 0.0,
) -> Run:
    """A drive among tags whose places are read 4 times a second, with stamps late by so much.

    Args:
        late_s: of the stamps.
        legs: of the drive.
        seed: of the noise: 3 cm of range and 10 mrad of bearing.
        in_camera: ranges and bearings about a camera that sits as robot.yaml says, instead of places in base.
        wrong_ids: share of observations that have another tag's id.
        heading_rad_per_sqrt_m: by which the robot's true heading departs from that by wheels.
        lasting: error that observations of one tag share for 5 s, in sigmas of their noise.
    """
    rng, drive, robot = np.random.default_rng(seed), make_drive([0.0, 0.0, 0.0], legs), make_robot()
    driven_m = np.diff((drive.left_m + drive.right_m) / 2, prepend=0.0)
    astray = np.cumsum(heading_rad_per_sqrt_m * np.sqrt(np.abs(driven_m)) * rng.standard_normal(len(driven_m)))
    heading = drive.T_world_base[:, 2] + astray
    step = driven_m[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    true = replace(drive, T_world_base=np.column_stack([np.cumsum(step, axis=0), heading]))
    taken_ns = np.arange(drive.stamps_ns[0] + S, drive.stamps_ns[-1] - S, S // 4)
    pose = true.at(taken_ns)
    away = TAGS_M - pose[:, None, :2]
    cos, sin = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
    xy_m = np.stack([cos * away[..., 0] + sin * away[..., 1], cos * away[..., 1] - sin * away[..., 0]], axis=-1)
    mount = np.array([robot.mount.x_m, robot.mount.y_m]) if in_camera else np.zeros(2)
    range_m, bearing_rad = np.hypot(*(xy_m - mount).T).T, np.arctan2(*(xy_m - mount).T[::-1]).T
    look, tag = np.nonzero((range_m < FARTHEST_M) & (np.abs(bearing_rad) < FIELD_RAD))
    while_s = (taken_ns[look] - drive.stamps_ns[0]) // (5 * S)
    same = rng.standard_normal((2, len(TAGS_M), int(while_s.max(initial=0)) + 1))[:, tag, while_s]
    error = rng.standard_normal((2, len(tag))) + lasting * same
    read = np.stack([range_m[look, tag] + 0.03 * error[0], bearing_rad[look, tag] + 0.01 * error[1]], axis=-1)
    value = read[:, :1] * np.stack([np.cos(read[:, 1]), np.sin(read[:, 1])], axis=-1)
    tag = np.where(rng.random(len(tag)) < wrong_ids, rng.integers(0, len(TAGS_M), len(tag)), tag)
    positions = make_positions(taken_ns[look] + round(late_s * S), tag, value)
    if in_camera:
        about_camera = np.stack([read[:, 0], read[:, 1] - robot.mount.yaw_rad], axis=-1)
        every = np.ones(len(tag), dtype=np.bool_)
        diagonal = np.broadcast_to(np.diag([0.03**2, 0.01**2]), (len(tag), 2, 2)).copy()
        positions = replace(positions, value=about_camera, polar=every, in_camera=every, covariance=diagonal)
    keys = [TagKey(FAMILY, i) for i in range(len(TAGS_M))]
    return make_run([drive.track], robot=robot, camera=None, tags=keys, positions=positions)


def tags_by_picture(*runs: Run) -> TimeOffsetSearch:
    found = search_time_offset(runs)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, float]:
    """A drive with corners of tags, and by how much its camera is late."""
    folder = tmp_path_factory.mktemp("search") / "drives"
    truth = simulate("nsh", 0, folder, ["loop"], render=False)
    (drawn,) = truth.runs.values()
    return load_run(find_logs([folder])[0]), drawn.parameters()["time_offset_s"]


@pytest.mark.parametrize("late_s", [-0.1, 0.3, 0.6])
def test_an_offset_of_a_camera_is_found(simulated: tuple[Run, float], late_s: float) -> None:
    run, drawn_s = simulated
    found = tags_by_picture(run.shift_stamps(-late_s))
    assert found.offset_s == pytest.approx(late_s + drawn_s, abs=3.0 * found.sigma_s)
    assert found.sigma_s < 0.02


@pytest.mark.parametrize("in_camera", [False, True])
@pytest.mark.parametrize("late_s", [-0.45, 0.0, 0.8])
def test_an_offset_of_imported_positions_is_found(late_s: float, in_camera: bool) -> None:
    found = tags_by_picture(position_run(late_s, in_camera=in_camera))
    assert found.offset_s == pytest.approx(late_s, abs=3.0 * found.sigma_s)
    assert found.sigma_s < 0.01
    assert len(found.grid_s) == len(found.cost) == 21
    assert abs(found.grid_s[np.argmin(found.cost)] - late_s) < 0.1
    assert found.cost.min() > -0.5


@pytest.mark.parametrize("share", [0.01, 0.05])
def test_some_ids_may_be_wrong(share: float) -> None:
    found = tags_by_picture(position_run(0.3, wrong_ids=share))
    assert found.offset_s == pytest.approx(0.3, abs=0.01)
    assert found.sigma_s < 0.012


def test_segments_and_runs_of_a_robot_are_one_drive_with_pauses() -> None:
    run = position_run(0.3)
    (track,) = run.wheel_segments
    half = len(track.stamps_ns) // 2
    first, second = (
        replace(track, stamps_ns=track.stamps_ns[part], left_m=track.left_m[part], right_m=track.right_m[part])
        for part in (slice(None, half), slice(half, None))
    )
    cut = replace(run, wheel_segments=(first, second))
    apart = [replace(run, wheel_segments=(each,)) for each in (first, second)]
    for found in (tags_by_picture(cut), tags_by_picture(*apart)):
        assert found.offset_s == pytest.approx(0.3, abs=3.0 * found.sigma_s)
    assert tags_by_picture(run, position_run(0.3, seed=1)).sigma_s < tags_by_picture(run).sigma_s + 1e-3


NO_OBSERVATIONS = position_run(legs=[(0.0, 0.0, 1.0)])


@pytest.mark.parametrize(
    "run",
    [
        pytest.param(position_run(legs=[(0.5, 0.5, 60.0)]), id="straight on at one speed"),
        pytest.param(position_run(legs=[(0.0, 0.0, 120.0)]), id="stands"),
        pytest.param(position_run(legs=75 * [(0.6, 0.3, 0.4), (0.3, 0.6, 0.4)]), id="as good 0.8 s earlier and later"),
        pytest.param(position_run(legs=ROUND[:2]), id="short"),
        pytest.param(position_run(1.4), id="later than a second"),
        pytest.param(replace(NO_OBSERVATIONS, wheel_segments=()), id="no wheels"),
        pytest.param(NO_OBSERVATIONS, id="no observations"),
    ],
)
def test_drives_that_do_not_determine_it(run: Run) -> None:
    assert search_time_offset([run]) is None


def test_what_is_no_number_is_no_observation() -> None:
    run = position_run(0.3)
    value = run.positions.value.copy()
    value[::3] = np.nan
    some = replace(run, positions=replace(run.positions, value=value))
    assert tags_by_picture(some).offset_s == pytest.approx(0.3, abs=0.02)
    none = replace(run.positions, value=np.full_like(value, np.nan))
    assert search_time_offset([replace(run, positions=none)]) is None
    (track,) = run.wheel_segments
    unknown = replace(track, left_m=np.full_like(track.left_m, np.nan))
    assert search_time_offset([replace(run, wheel_segments=(unknown,))]) is None
    assert search_time_offset([]) is None


def test_one_tag_with_few_observations_determines_nothing() -> None:
    run = position_run(0.3)
    once = np.flatnonzero(run.positions.tag == run.positions.tag[0])[::12]
    rarely = run.positions.where(np.isin(np.arange(len(run.positions.tag)), once))
    assert search_time_offset([replace(run, positions=rarely)]) is None


def test_sigma_is_what_estimates_err_by() -> None:
    found = [
        tags_by_picture(position_run(0.2, seed=seed, heading_rad_per_sqrt_m=0.05, lasting=3.0, legs=4 * ROUND))
        for seed in range(24)
    ]
    off = np.array([(each.offset_s - 0.2) / each.sigma_s for each in found])
    assert 0.4 < (off**2).mean() < 2.0
    assert np.abs(off).max() < 4.0


def test_of_a_long_drive_some_passes_of_all_its_parts_are_worked_out() -> None:
    passes = find_passes([position_run(legs=12 * TO_AND_FRO)])
    assert passes is not None
    assert len(passes) == 200
    counts = np.bincount(passes.group)
    assert (counts.min(), counts.max()) == (3, 8)
    begins_s = passes.stations_s[passes.first_station]
    assert (np.diff(begins_s) >= 0.0).all()
    of_fifths, _ = np.histogram(begins_s, bins=5, range=(0.0, passes.wheels.time_s[-1]))
    assert of_fifths.min() > 25
    np.testing.assert_array_equal(passes.station_group[passes.at], passes.group)
    within = np.diff(passes.station_group) == 0
    steps_s = np.diff(passes.stations_s)[within]
    assert steps_s.min() > 0.0
    assert steps_s.max() < 0.25 + 1e-9


def test_no_pass_goes_over_a_pause_or_is_read_while_the_robot_stands() -> None:
    run = position_run(legs=(*TO_AND_FRO, (0.0, 0.0, 100.0), *TO_AND_FRO))
    looks_ns = run.positions.stamps_ns
    seen = replace(run, positions=run.positions.where((looks_ns - looks_ns[0]) // S % 9 < 4))  # nothing for 5 s
    passes = find_passes([seen])
    assert passes is not None
    begins_s = passes.stations_s[passes.first_station]
    lasts_s = np.maximum.reduceat(passes.stations_s, passes.first_station) - begins_s
    assert lasts_s.max() < 4.0
    assert (begins_s > 120.0).any()
    stands_s = float(sum(leg[2] for leg in TO_AND_FRO)) + np.array([1.0, 99.0])
    assert not ((begins_s > stands_s[0]) & (begins_s + lasts_s < stands_s[1])).any()


def smooth(wheels: WheelAxis) -> WheelAxis:
    """Wheels whose speeds are what their distances change by, to the last digit."""
    t = np.linspace(wheels.time_s[0], wheels.time_s[-1], 200_000)
    distance_m = np.stack([0.5 * t + 0.3 * np.sin(t), 0.4 * t - 0.3 * np.cos(1.1 * t), 0.2 * np.sin(0.7 * t)])
    speed_m_s = np.stack([0.5 + 0.3 * np.cos(t), 0.4 + 0.33 * np.sin(1.1 * t), 0.14 * np.cos(0.7 * t)])
    return replace(wheels, time_s=t, motion=np.concatenate([distance_m, speed_m_s]).T)


def test_derivatives_are_those_of_residuals() -> None:
    passes = find_passes([position_run(0.2, in_camera=True, legs=2 * ROUND)])
    assert passes is not None
    passes = replace(passes, wheels=smooth(passes.wheels))
    at = np.array([0.11, 0.02, -0.1, 0.1, -0.2, 0.05, 0.03, 0.04])
    tags_m = tag_positions(passes, at)
    model = linearise(passes, at, tags_m)
    for i in range(len(PARAMETERS)):
        h = np.zeros(len(at))
        h[i] = 1e-3 if i == 0 else 1e-5
        numeric = differences(linearise(passes, at + h, tags_m).residual, linearise(passes, at - h, tags_m).residual)
        np.testing.assert_allclose(model.by_parameters[..., i], numeric / (2 * h[i]), atol=1e-4, rtol=1e-3)
    for i in range(2):
        h = 1e-5 * np.eye(2)[i]
        numeric = differences(linearise(passes, at, tags_m + h).residual, linearise(passes, at, tags_m - h).residual)
        np.testing.assert_allclose(model.by_tag[..., i], numeric / 2e-5, atol=1e-6)


def differences(after: FloatArray, before: FloatArray) -> FloatArray:
    """Of ranges and bearings; the latter may go once round."""
    apart = after - before
    return np.stack([apart[:, 0], wrap_angle(apart[:, 1])], axis=-1)


def test_where_observations_put_their_tag_is_where_it_is() -> None:
    passes = find_passes([position_run(0.0, in_camera=True)])
    assert passes is not None
    zero = np.zeros(len(PARAMETERS))
    residual = linearise(passes, zero, tag_positions(passes, zero)).residual
    assert residual[:, 0].std() == pytest.approx(0.03, rel=0.2)  # the noise
    assert residual[:, 1].std() == pytest.approx(0.01, rel=0.4)


@pytest.mark.parametrize(("off_s", "is_replaced"), [(0.0, False), (0.15, True)])
def test_a_measured_clock_beside_an_open_track_is_replaced_only_where_drives_contradict_it(
    off_s: float, is_replaced: bool
) -> None:
    """As of a skid-steer robot, whose owner knows when pictures were taken but not how it turns."""
    run = position_run(off_s, in_camera=True)
    wheels = run.robot.wheels.model_copy(update={"track_m_sigma": 0.15 * run.robot.wheels.track_m})
    robot = run.robot.model_copy(update={"wheels": wheels, "time_offset_s_sigma": 0.001})
    found = estimate_start_values([replace(run, robot=robot)], NoiseParameters())
    assert abs(found.searches["time_offset_s"].offset_s - off_s) < 0.02
    if is_replaced:
        assert found.corrections["time_offset_s"].value == pytest.approx(off_s, abs=0.02)
    else:
        assert found.searches["time_offset_s"].offset_s != 0.0
        assert found.corrections["time_offset_s"].value == 0.0
