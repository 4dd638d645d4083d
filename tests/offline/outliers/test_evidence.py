"""Evidence at a solve that went wrong: it must be finite."""

import numpy as np

from groundsbot.offline.outliers.evidence import LinearisedObservations, find_contradictions
from groundsbot.offline.outliers.tracks import tracks_of
from groundsbot.offline.sam.graph import build_graph
from tests.support.data.long_drives import make_long_drive


def test_a_tag_inside_a_camera_is_no_contradiction_and_no_error() -> None:
    """There the bearing's derivative is as large as one over the range, and the information of a track is singular."""
    drive = make_long_drive(2, 100.0)
    segment = drive.segment
    graph = build_graph([segment])
    tracks = tracks_of([segment])
    n = len(segment.observations)
    direction = np.array([1.0, 1.0])
    by_tag = np.broadcast_to([direction, 1e9 * direction], (n, 2, 2)).copy()
    at = LinearisedObservations(graph.problem, drive.true_state(graph), np.ones((n, 2)), by_tag)
    with np.errstate(all="raise"):
        assert not find_contradictions(at, tracks).any()
