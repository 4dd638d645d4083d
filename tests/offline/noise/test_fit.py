"""The noise of drives, found again from far off; and where it is not accepted."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS, TIME_OFFSET
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps.parameter_results import NOT_NEEDED
from groundsbot.offline.measurements.motion_model.motion_model import ODOMETRY_NOISE
from groundsbot.offline.measurements.run import Run, load_run
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.sensor_model.imported_positions import POSITION_NOISE, STAMP_NOISE
from groundsbot.offline.noise import fit as noise_fit
from groundsbot.offline.noise import likelihood
from groundsbot.offline.noise.fit import fit_noise
from groundsbot.offline.noise.likelihood import LikelihoodEvaluator
from groundsbot.offline.noise.reweighing import fit_noise_of, with_noise_of_map
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.trust.noise_study import Mapped, study_seed, summary
from tests.support.data.drives import MadeTag, make_drive, make_robot, write_drive
from tests.support.data.simulated_runs import simulated_runs

PRIOR = NoiseParameters()
HALL = [MadeTag(0, (6.0, 1.0, 0.5), np.pi), MadeTag(1, (6.0, 3.0, 0.4), np.pi), MadeTag(2, (0.0, 1.2, 0.45), 0.1)]


@pytest.fixture(scope="module")
def maps(room: Path) -> list[LocalMap]:
    return [solve_local_map(segment) for log in find_logs([room]) for segment in segments_of(load_run(log), PRIOR)]


def test_noise_is_found_from_ten_times_too_large_and_too_small() -> None:
    """The whole study is tests/benchmarks/trust/noise_study.py."""
    rows = [row for row in study_seed("room", 3, (0.1, 10.0)) if isinstance(row, Mapped)]
    lines, _ = summary(rows)
    assert lines[-1].startswith("2 maps: mean tags NEES")
    for row in rows:
        # Wheels that slip go sideways too, which no lateral noise was drawn for.
        fitted = {
            each.found.name: each
            for each in row.parameters
            if not each.found.kept and each.found.name != "sigma_lateral_m_per_sqrt_m"
        }
        assert fitted.keys() >= {"sigma_corner_px", "sigma_distance_m_per_sqrt_m"}
        for each in fitted.values():
            assert each.found.high is not None
            assert abs(np.log(each.ratio)) / np.log(each.found.high / each.found.value) < 4.0 / 2.576
            assert each.close in (True, None)
        assert 0.2 < row.nees_tags < 2.5


def test_fitted_noise_is_used_and_reported(room: Path) -> None:
    result = build_map(read_runs(find_logs([room])))
    assert result.noise_fit is not None
    assert result.noise_fit.runs == ("a_seed3", "b_seed3", "c_seed3")
    by_name = {each.name: each for each in result.noise_fit.parameters}
    assert list(by_name) == list(NoiseParameters.model_fields)
    for name, each in by_name.items():
        assert each.value == getattr(result.noise, name)
        assert (each.low is None) == bool(each.kept)
    corner = by_name["sigma_corner_px"]
    assert corner.low is not None
    assert corner.high is not None
    assert corner.low < corner.value < corner.high
    assert corner.value != PRIOR.sigma_corner_px
    assert by_name["sigma_range_m"].kept == NOT_NEEDED
    assert by_name["sigma_range_m"].value == PRIOR.sigma_range_m


def test_noise_that_is_given_is_fitted_no_more(room: Path) -> None:
    given = PRIOR.model_copy(update={"sigma_corner_px": 0.4})
    result = build_map(read_runs(find_logs([room / "a"])), noise=given)
    assert result.noise == given
    assert result.noise_fit is None


def test_a_run_that_contradicts_itself_determines_no_noise_and_gets_no_more_weight(maps: list[LocalMap]) -> None:
    odd = replace(maps[0], goodness=replace(maps[0].goodness, chi_square=1e4))
    found = fit_noise_of([odd, *maps[1:]], PRIOR)
    assert found.fitted.runs == tuple(each.segment.name for each in maps[1:])
    assert found.fitted.contradicting == (odd.segment.name,)
    assert found.noise == fit_noise_of(maps[1:], PRIOR).noise
    larger = {name: max(value, getattr(PRIOR, name)) for name, value in found.noise.model_dump().items()}
    assert larger != found.noise.model_dump()
    expected = maps[0].segment.with_noise(NoiseParameters(**larger)).odometry.covariance
    np.testing.assert_allclose(found.solve(odd).segment.odometry.covariance, expected)
    alone = fit_noise_of([odd], PRIOR)
    assert alone.noise == PRIOR
    assert {each.kept for each in alone.fitted.parameters} == {"no run has tag observations that fit together"}
    assert alone.solve(odd) is odd


@pytest.mark.parametrize("n_late", [1, 2])
def test_of_long_runs_beginnings_may_be_without_tags(
    maps: list[LocalMap], monkeypatch: pytest.MonkeyPatch, n_late: int
) -> None:
    late = [_read_late(each.segment) for each in maps[:n_late]]
    both = [*(solve_local_map(segment) for segment in late), *maps[n_late:2]]
    monkeypatch.setattr(noise_fit, "_MAX_KEYFRAMES", int(0.4 * sum(len(each.segment.stamps_ns) for each in both)))
    found = fit_noise_of(both, PRIOR)
    by_name = {each.name: each for each in found.fitted.parameters}
    assert not by_name["sigma_distance_m_per_sqrt_m"].kept or n_late == 2
    assert max(found.fitted.shared_range, found.fitted.shared_bearing) < 1e-3 or n_late == 1


def test_of_a_fleet_each_drive_keeps_enough_keyframes(maps: list[LocalMap], monkeypatch: pytest.MonkeyPatch) -> None:
    """Tags are observed several times in a pass, however many drives there are."""
    wanted = {each.name: each for each in fit_noise(maps, PRIOR).sigmas}
    fleet = 4 * maps
    monkeypatch.setattr(noise_fit, "_MAX_KEYFRAMES", 2 * len(fleet))
    found = {each.name: each for each in fit_noise(fleet, PRIOR).sigmas}
    for name in ("sigma_corner_px", "sigma_distance_m_per_sqrt_m"):
        assert not found[name].kept
        assert wanted[name].low < found[name].value < wanted[name].high


def _read_late(segment: Segment) -> Segment:
    """Without the observations of its first half."""
    observations = segment.observations.where(segment.observations.keyframe >= len(segment.stamps_ns) // 2)
    seen, tag = np.unique(observations.tag, return_inverse=True)
    return replace(segment, tags=tuple(segment.tags[i] for i in seen), observations=replace(observations, tag=tag))


def test_implausible_noise_is_not_accepted(tmp_path: Path) -> None:
    """Observations without any error: less noise than the best of encoders and lenses leave."""
    legs = [(0.4, 0.4, 4.0), (0.5, 0.3, 4.0), (-0.3, 0.3, 3.0), (0.4, 0.4, 3.0)]
    log = write_drive(tmp_path, make_drive([1.0, 1.5, 0.3], legs), HALL, make_robot("a"))
    result = build_map(read_runs([log]))
    assert result.noise_fit is not None
    assert all(each.kept for each in result.noise_fit.parameters)
    for name, value in PRIOR.model_dump().items():
        assert getattr(result.noise, name) == pytest.approx(value, rel=0.02), name


def test_noise_that_other_noise_explains_is_small_and_not_the_default(
    maps: list[LocalMap], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Corners that might err in range and bearing besides, and do not: the defaults are more than the drives show.

    Beside so many sigmas that of distances varies by a fifth with the random errors, so many are drawn.
    """
    monkeypatch.setattr(likelihood, "_N_ERRORS", (1024, 1024))
    monkeypatch.setattr(likelihood, "_N_SIGNS", (128, 128))
    noise = NoiseParameters(sigma_corner_px=0.3)
    without = {each.name: each for each in fit_noise(maps, noise).sigmas}
    both = [replace(each, segment=each.segment.with_noise(noise).with_position_noise(POSITION_NOISE)) for each in maps]
    sigmas = {each.name: each for each in fit_noise(both, noise).sigmas}
    assert sigmas["sigma_range_m"].value < 0.1 * noise.sigma_range_m
    assert sigmas["sigma_bearing_rad"].value < 0.1 * noise.sigma_bearing_rad
    for name in ("sigma_corner_px", "sigma_distance_m_per_sqrt_m", "sigma_heading_rad_per_sqrt_m"):
        assert sigmas[name].value == pytest.approx(without[name].value, rel=0.15), name


def test_the_fit_ends_in_an_answer_however_far_from_the_default(maps: list[LocalMap]) -> None:
    """Wheels that err fifty times as much as they are taken to."""
    odd = []
    for each in maps:
        odometry = each.segment.odometry
        parts = replace(odometry.parts, unit=odometry.parts.unit / 50.0**2)
        odd.append(replace(each, segment=replace(each.segment, odometry=replace(odometry, parts=parts))))
    found = fit_noise_of(odd, PRIOR)
    as_told = fit_noise_of(maps, PRIOR)
    ratio = found.noise.sigma_distance_m_per_sqrt_m / as_told.noise.sigma_distance_m_per_sqrt_m
    assert ratio == pytest.approx(50.0, rel=0.15)
    (sigma,) = [each for each in found.fitted.parameters if each.name == "sigma_distance_m_per_sqrt_m"]
    assert not sigma.kept
    assert sigma.low is not None
    assert sigma.high is not None
    assert sigma.low < sigma.value < sigma.high


@pytest.mark.parametrize("jitter_s", [0.0, 0.02])
def test_jitter_of_stamps_is_estimated_from_all_tags_of_a_picture(maps: list[LocalMap], jitter_s: float) -> None:
    """Errors are common to the tags of a picture, so residuals are larger than those of as many independent errors."""
    rng = np.random.default_rng(2)
    late = []
    for each in maps:
        observations = each.segment.observations
        error_s = jitter_s * rng.standard_normal(len(each.segment.stamps_ns))[observations.keyframe, None]
        value = observations.value + error_s * observations.by_camera[..., CAMERA_PARAMETERS.index(TIME_OFFSET)]
        segment = replace(each.segment, observations=replace(observations, value=value)).with_position_noise(
            (STAMP_NOISE,)
        )
        late.append(replace(solve_local_map(segment), is_noisy=True))
    (sigma,) = [each for each in fit_noise(late, PRIOR).sigmas if each.name == STAMP_NOISE]
    assert sigma.value == pytest.approx(jitter_s, abs=0.003)


def test_jitter_of_headings_is_not_taken_for_other_noise(maps: list[LocalMap]) -> None:
    """It is common to the tags of a picture, so the poses absorb more of it than of as many independent errors."""
    rng = np.random.default_rng(4)
    plain, jittered = fit_noise(maps, PRIOR).noise, []
    for each in maps:
        sigma_rad = np.full(len(each.segment.observations), 2e-3)
        observations = each.segment.observations.with_heading_jitter(sigma_rad)
        error = rng.standard_normal(len(each.segment.stamps_ns))[observations.keyframe, None]
        observations = replace(observations, value=observations.value + error * observations.jitter_root)
        jittered.append(solve_local_map(replace(each.segment, observations=observations)))
    found = fit_noise(jittered, PRIOR).noise
    for name in ("sigma_corner_px", "sigma_distance_m_per_sqrt_m", "sigma_heading_rad_per_sqrt_m"):
        assert getattr(found, name) == pytest.approx(getattr(plain, name), rel=0.2)


def test_no_estimate_leaves_more_of_errors_than_there_is(maps: list[LocalMap]) -> None:
    """Else what a good estimate leaves would look like sigmas that are far too small."""
    segment = maps[0].segment.with_position_noise((STAMP_NOISE,))
    names = ("sigma_corner_px", STAMP_NOISE)
    sigma = np.array([0.2, 0.5])
    looker = LikelihoodEvaluator(noise_fit._part(solve_local_map(segment), segment, PRIOR, names))
    variances = np.append(sigma**2, np.full(4, 0.05))
    seen = looker.evaluate(variances)
    assert (seen.expected < 1.02 * seen.without_fit).all()


def test_lateral_noise_is_the_same_whether_the_mount_was_measured_or_not() -> None:
    """At the joint optimum a free mount lies too far ahead, and what that costs looked like lateral slip: 1.4 times."""
    runs, _ = simulated_runs("nsh", 4)
    assert _lateral_noise([_with_free_mount(run) for run in runs]) < 1.2 * _lateral_noise(runs)


def _lateral_noise(runs: Sequence[Run]) -> float:
    maps = [solve_local_map(segment) for run in runs for segment in segments_of(run, PRIOR)]
    return fit_noise(maps, PRIOR).noise.sigma_lateral_m_per_sqrt_m


def _with_free_mount(run: Run) -> Run:
    sigmas = {"x_m_sigma": 0.5, "y_m_sigma": 0.5, "yaw_rad_sigma": 0.15}
    robot = run.robot.model_copy(update={"mount": run.robot.mount.model_copy(update=sigmas)})
    robot = robot.model_copy(update={"time_offset_s_sigma": 0.3, "range_offset_m_sigma": 0.05})
    return replace(run, robot=robot)


def test_what_observations_of_a_tag_share_makes_them_count_for_less() -> None:
    """A bias that lasts for metres: corners look better than what they say of the tag's place."""
    runs, _ = simulated_runs("nsh", 3, ["hallway"])
    maps = [solve_local_map(segment) for run in runs for segment in segments_of(run, PRIOR)]
    rng = np.random.default_rng(1)
    biased = []
    for each in maps:
        observations = each.segment.observations
        root = np.linalg.cholesky(observations.covariance)
        part = (np.append(0.0, np.cumsum(each.segment.odometry.distance_m))[observations.keyframe] / 2.5).astype(int)
        n_parts = int(part.max()) + 1
        shared = rng.standard_normal((n_parts, len(each.segment.tags), 2))[part, observations.tag]
        value = observations.value + (root @ shared[..., None])[..., 0]
        biased.append(solve_local_map(replace(each.segment, observations=replace(observations, value=value))))
    good, bad = fit_noise_of(maps, PRIOR), fit_noise_of(biased, PRIOR)
    assert good.fitted.shared_range + good.fitted.pass_range < 0.03
    assert bad.fitted.shared_range + bad.fitted.pass_range > 0.1
    for before in biased:
        after = bad.solve(before)
        spread = after.segment.observations.covariance[:, 0, 0] / before.segment.observations.covariance[:, 0, 0]
        assert np.median(spread) > 2.0
        np.testing.assert_allclose(
            after.segment.observations.parts.under(bad.noise), after.segment.observations.covariance
        )


@pytest.mark.parametrize("prior", [PRIOR, NoiseParameters(sigma_corner_px=0.05)])
def test_refined_corners_share_at_least_what_refining_leaves(maps: list[LocalMap], prior: NoiseParameters) -> None:
    """Of m observations of a tag within 2.5 m each counts with 1 + m s, s by the pixels that they err by alike."""
    plain = [solve_local_map(each.segment.with_noise(prior)) for each in maps]
    refined = []
    for each in plain:
        bias_px = np.tile([0.1, 0.2], (len(each.segment.observations), 1))
        segment = replace(each.segment, observations=replace(each.segment.observations, corner_bias_px=bias_px))
        refined.append(replace(each, segment=segment))
    for before, after in zip(
        with_noise_of_map(plain, prior, None), with_noise_of_map(refined, prior, None), strict=True
    ):
        assert (before.segment.observations.corner_sigmas == 1.0).all()
        times = after.segment.observations.covariance[:, 0, 0] / before.segment.observations.covariance[:, 0, 0]
        m = (times - 1.0) / (0.1 / prior.sigma_corner_px) ** 2
        np.testing.assert_allclose(m, np.rint(m), rtol=1e-6)
        of_corners = m * 0.2**2 / (prior.sigma_corner_px**2 + 0.2**2)
        np.testing.assert_allclose(after.segment.observations.corner_sigmas, np.sqrt(1.0 + of_corners), rtol=1e-9)
        assert m.min() >= 1.0
        assert m.max() > 5.0


@pytest.mark.parametrize("noise", [None, NoiseParameters(sigma_corner_px=0.05)])
def test_refined_corners_share_errors_whether_their_noise_is_fitted_or_given(
    room: Path, noise: NoiseParameters | None
) -> None:
    runs = read_runs(find_logs([room]))
    times = []
    for refined in (False, True):
        workings = Diagnostics(keeps_corners=True)
        build_map([replace(run, corners_refined=refined) for run in runs], noise, workings=workings)
        segments = [each.segment for each in workings.maps]
        times.append(np.concatenate([segment.observations.corner_sigmas for segment in segments]).max())
    assert times[1] > 1.2 * times[0]


def test_observations_with_undetermined_correlation_get_no_more_weight_than_before(maps: list[LocalMap]) -> None:
    """A few metres past a tag: the scatter of its corners says nothing of a bias in all of them."""
    short = maps[0].segment.prefix(60)
    better = replace(short, observations=replace(short.observations, value=short.observations.value))
    found = fit_noise_of([solve_local_map(better)], PRIOR)
    for each in found.fitted.parameters:
        if each.name not in ODOMETRY_NOISE:
            assert each.value >= getattr(PRIOR, each.name)
