"""Starts of online drives: right whatever the noise of their observations and the error of the start."""

from dataclasses import replace
from itertools import islice
from typing import Final

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.localization.localization import localize
from groundsbot.offline.localization.online.drive import TagMeasurement
from groundsbot.offline.localization.online.localizer import OnlineLocalizer
from groundsbot.offline.localization.online.smoother import Smoother
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.measurements.tags import TagKey
from tests.benchmarks.accuracy.localize_study import Scene, taken_one_by_one
from tests.support.data.drives import make_drive, make_robot, write_drive
from tests.support.data.map_cases import TAGS

_N_KEYFRAMES: Final = 12  # keyframes, after which a start has converged


def test_all_starts_end_in_the_same_optimum(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 100 with other noise, 3 cm and 3 degrees off: four tags are in the first picture, so each pose counts at once.

    If rounding turns poses while one tag was seen, some begin up to half a turn off.
    """
    drive = make_drive([0.0, 0.0, 0.2], [(0.0, 0.0, 0.5), (0.5, 0.52, 3.0)])
    log = write_drive(tmp_path_factory.mktemp("logs"), drive, TAGS, make_robot("a"), corner_sigma_px=0.3)
    (run,) = read_runs([log])
    known = build_map([replace(run, name="earlier")])
    (segment,) = segments_of(run, known.noise)
    (located,) = localize(run, known, noise=known.noise).runs
    place, T_start_off = Smoother.place, np.zeros(3)

    def place_off(
        smoother: Smoother, T_map_start: FloatArray, held: dict[int, TagKey], maybe: dict[int, tuple[TagKey, ...]]
    ) -> None:
        place(smoother, se2.compose(T_map_start, T_start_off), held, maybe)

    monkeypatch.setattr(Smoother, "place", place_off)
    wrong, n_poses = {}, 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        T_start_off[:] = rng.normal(size=3) * [0.03, 0.03, np.radians(3.0)]
        online = OnlineLocalizer(known, segment.run.robot)
        for k, (motion, observations) in enumerate(islice(taken_one_by_one(segment), _N_KEYFRAMES)):
            if motion is not None:
                online.add_motion(*motion)
            for observation in observations:
                online.add_observation(_noisy(observation, rng))
            if online.pose is not None:
                off = online.pose.T_map_base - located.T_map_base[k]
                off[2] = se2.wrap_angle(off[2])
                n_poses += 1
                if np.abs(off).max() > 0.2:
                    wrong[seed, k] = off
    assert not wrong
    assert n_poses > 0.95 * 100 * (_N_KEYFRAMES - 1)  # not known at the first keyframe


def test_while_one_tag_was_seen_linearisation_points_do_not_turn(scene: Scene) -> None:
    """A single tag has no rotation; without a guard its rounding turned a pose in half of these 20 drives."""
    segment = scene.drive.segment
    first = segment.tags[segment.observations.tag[0]].tag_id
    turned = {}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        online = OnlineLocalizer(scene.known, segment.run.robot)
        smoother = online._smoother
        for k, (motion, observations) in enumerate(taken_one_by_one(segment)):
            if motion is not None:
                online.add_motion(*motion)
            for observation in observations:
                if observation.tag_id == first:
                    online.add_observation(_noisy(observation, rng))
            assert smoother.front is not None
            turn_rad = float(se2.wrap_angle(smoother.drive.poses[-1, 2] - smoother.front.pose[2]))
            if abs(turn_rad) > 0.05:
                turned[seed, k] = turn_rad
            if k == 80:
                break
    assert not turned


def _noisy(observation: TagMeasurement, rng: np.random.Generator) -> TagMeasurement:
    """The observation with more noise, of half its sigmas."""
    noise = np.linalg.cholesky(observation.covariance) @ rng.normal(size=2)
    return replace(observation, value=observation.value + 0.5 * noise)
