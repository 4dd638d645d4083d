"""Derivatives by the camera's roll and pitch, from pictures with noise, against those from exact ones."""

from pathlib import Path

import numpy as np

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.measurements.run import load_run
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.smoothed_faces import with_smoothed_faces
from tests.support.data.drives import HALL, MadeDrive, make_drive, make_robot, write_drive

NOISE_PX = 0.2


def _segment(folder: Path, drive: MadeDrive, noise_px: float) -> Segment:
    run = load_run(write_drive(folder, drive, HALL, make_robot("a"), corner_sigma_px=noise_px))
    (segment,) = segments_of(run, NoiseParameters())
    return segment


def test_derivatives_have_half_the_error_of_single_pictures_at_most(tmp_path: Path) -> None:
    drive = make_drive([1.0, 2.0, 0.0], [(0.3, 0.3, 6.0), (-0.2, 0.2, 7.8), (0.3, 0.3, 6.0)])
    exact, noisy = _segment(tmp_path / "exact", drive, 0.0), _segment(tmp_path / "noisy", drive, NOISE_PX)
    true = drive.at(noisy.stamps_ns)
    poses = se2.compose(se2.inverse(true[0]), true)
    smoothed = with_smoothed_faces(noisy, poses, noisy.observations.value[:, 0])
    seen = [list(zip(each.observations.keyframe, each.observations.tag, strict=True)) for each in (exact, noisy)]
    assert seen[0] == seen[1]
    wanted = exact.observations.by_camera[..., :2]
    before, after = (
        np.sqrt(np.mean((each.observations.by_camera[..., :2] - wanted) ** 2, axis=0)) for each in (noisy, smoothed)
    )
    assert (after < 0.5 * before).all()
    np.testing.assert_array_equal(smoothed.observations.by_camera[..., 2:], noisy.observations.by_camera[..., 2:])


def test_exact_derivatives_stay(tmp_path: Path) -> None:
    drive = make_drive([1.0, 2.0, 0.0], [(0.3, 0.3, 6.0)])
    segment = _segment(tmp_path, drive, 0.0)
    true = drive.at(segment.stamps_ns)
    poses = se2.compose(se2.inverse(true[0]), true)
    smoothed = with_smoothed_faces(segment, poses, segment.observations.value[:, 0])
    np.testing.assert_allclose(smoothed.observations.by_camera, segment.observations.by_camera, rtol=1e-4, atol=1e-5)
