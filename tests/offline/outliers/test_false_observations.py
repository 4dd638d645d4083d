"""Codes that are misread as the same tag at two places of a drive, which would join these places."""

from dataclasses import replace

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements.passes import without_unconfirmed_tracks
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.outliers.false_observations import without_false_detections
from tests.support.data.drives import FAMILY, START_NS, S, make_drive, make_positions, make_robot, make_run

PLACES = {i: np.array([2.0 * i + 2.0, 1.0 if i % 2 else -1.0]) for i in range(10)}
GHOST = 10  # read once near the beginning and once near the end, where there is no tag
READ_AT_S = (2.0, 18.0)
SPEED_M_S = 1.0


def _segment(ghosts_m: tuple[FloatArray, FloatArray]) -> Segment:
    """A straight drive of 20 m past ten tags, each read ten times a second from 2 m, and twice as the ghost."""
    drive = make_drive([0.0, 0.0, 0.0], [(SPEED_M_S, SPEED_M_S, 20.0)])
    rng = np.random.default_rng(0)
    rows = []
    for k in range(10, 190):
        along_m = 0.1 * k * SPEED_M_S
        rows += [(0.1 * k, i, place) for i, place in PLACES.items() if 0.0 < place[0] - along_m < 2.0]
    rows += [(at_s, GHOST, place) for at_s, place in zip(READ_AT_S, ghosts_m, strict=True)]
    rows.sort(key=lambda row: row[:2])
    seconds, tags, places = (np.array(column) for column in zip(*rows, strict=True))
    poses = np.column_stack([SPEED_M_S * seconds, np.zeros((len(rows), 2))])
    xy_m = se2.apply(se2.inverse(poses), places) + 0.02 * rng.standard_normal((len(rows), 2))
    positions = make_positions(START_NS + np.round(seconds * S).astype(np.int64), tags, xy_m)
    keys = [TagKey(FAMILY, i) for i in (*PLACES, GHOST)]
    run = make_run([drive.track], robot=make_robot(), tags=keys, positions=positions)
    (segment,) = segments_of(run, NoiseParameters())
    return segment


def _n_ghosts(segment: Segment) -> int:
    return sum(segment.tags[tag].tag_id == GHOST for tag in segment.observations.tag)


def _solved_as_noisy(segment: Segment) -> LocalMap:
    """The local map of the segment without its unconfirmed tracks, as of a drive whose noise was unknown."""
    return replace(solve_local_map(without_unconfirmed_tracks(segment)), unfiltered=segment)


def test_of_two_single_observations_of_a_tag_one_is_left_out_at_first() -> None:
    segment = _segment((np.array([4.0, 1.5]), np.array([19.0, 1.5])))
    kept = without_unconfirmed_tracks(segment)
    assert (_n_ghosts(segment), _n_ghosts(kept)) == (2, 1)
    assert len(segment.observations) - len(kept.observations) == 1


def test_two_single_observations_at_two_places_are_both_misread() -> None:
    segment = _segment((np.array([4.0, 1.5]), np.array([19.0, 1.5])))
    found = without_false_detections(_solved_as_noisy(segment))
    assert _n_ghosts(found.segment) == 0
    assert found.n_misread == 2


def test_two_single_observations_at_one_place_are_both_kept() -> None:
    place = np.array([19.0, 1.5])
    found = without_false_detections(_solved_as_noisy(_segment((place, place))))
    assert _n_ghosts(found.segment) == 2
    assert found.n_misread == 0
