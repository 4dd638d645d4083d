"""The noise file."""

from pathlib import Path

import pytest

from groundsbot.calib.errors import CalibError
from groundsbot.calib.robot.noise import NoiseParameters, read_noise_yaml


def test_what_the_file_leaves_out_keeps_its_default(tmp_path: Path) -> None:
    path = tmp_path / "noise.yaml"
    path.write_text("sigma_range_m: 5e-3  # a number, exponent without a point\n")
    assert read_noise_yaml(path) == NoiseParameters(sigma_range_m=0.005)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sigma_corner_px: 0", ["sigma_corner_px", "0", "greater than or equal to 0.000000001"]),
        ("sigma_corner_px: -0.1", ["sigma_corner_px", "-0.1", "greater than or equal to 0.000000001"]),
        ("sigma_corner_px: 1e-200", ["sigma_corner_px", "1e-200", "greater than or equal to 0.000000001"]),
        ("sigma_distance_m_per_sqrt_m: 1.0e+200", ["1e+200", "less than or equal to 1000"]),
        ("sigma_corner_px: .inf", ["sigma_corner_px", "inf", "less than or equal to 1000"]),
        ("sigma_corner_px: true", ["sigma_corner_px", "True", "number"]),
        ("sigma_corner_px: 0.2 px", ["sigma_corner_px", "'0.2 px'", "number"]),
        ("sigma_corners_px: 0.2", ["sigma_corners_px", "0.2", "did you mean sigma_corner_px?"]),
        ("corner: 0.2", ["corner", "sigma_distance_m_per_sqrt_m"]),
        ("sigma_corner_px: 1\nsigma_corner_px: 2", ["line 2", "sigma_corner_px", "twice"]),
    ],
)
def test_a_bad_value_gives_one_clear_line(tmp_path: Path, text: str, words: list[str]) -> None:
    path = tmp_path / "noise.yaml"
    path.write_text(text)
    with pytest.raises(CalibError) as caught:
        read_noise_yaml(path)
    assert "\n" not in str(caught.value)
    for word in [str(path), *words]:
        assert word in str(caught.value)
