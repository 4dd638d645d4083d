"""What `calibrate` says of each correction."""

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.maps.parameter_results import CalibrationResult
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.self_calibration.words import correction_lines


def test_what_drives_determine_is_told_from_what_they_do_not() -> None:
    seen = CalibrationResult("carl", "mount_x_m", 0, 0.0108, 0.0092, 0.5)
    unseen = CalibrationResult("carl", "track_scale", 0, 0.0, 0.29, 0.3)
    no_drive = CalibrationResult("carl", "gyro_scale", 0, 0.0, 0.01, 0.01)
    lines = correction_lines(MapResult((), (), NoiseParameters()), [seen, unseen, no_drive])
    assert lines[0] == "mount_x_m of carl: +0.01080 (sigma 0.00920); estimated from robot.yaml's sigma 0.50000"
    assert lines[1].startswith("track_scale of carl: +0.00000 (sigma 0.29000); not determined by these drives; to")
    assert lines[1].endswith("; to determine it, turn on the spot, whole turns to either side, in view of tags")
    assert lines[2].endswith("; not determined by these drives")
