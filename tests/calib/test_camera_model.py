"""The camera model against OpenCV, and its files."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.calib.camera.file import CameraEstimate, read_camera_yaml, read_estimate, write_camera_yaml
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation.arrays import FloatArray

PLUMB_BOB = CameraModel(
    "wide", 1280, 720, 901.3, 899.8, 645.2, 352.7, "plumb_bob", (-0.31, 0.12, 0.0007, -0.0004, -0.02)
)
# The factory's own values of a depth camera, colour picture.
RATIONAL = CameraModel(
    "depth",
    1280,
    720,
    605.9,
    605.7,
    637.8,
    366.9,
    "rational_polynomial",
    (0.513, -2.741, 0.00064, -0.00022, 1.574, 0.393, -2.560, 1.499),
)
EQUIDISTANT = CameraModel(
    "fisheye", 1280, 720, 622.4, 621.1, 633.0, 358.4, "equidistant", (-0.0131, 0.0072, -0.0099, 0.0028)
)
UNDISTORTED = CameraModel("ideal", 640, 480, 500.0, 500.0, 319.5, 239.5, "plumb_bob", (0.0,) * 5)
CAMERAS = [PLUMB_BOB, RATIONAL, EQUIDISTANT, UNDISTORTED]
every_camera = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)

# As ROS's camera_calibration writes it.
ROS_FILE = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [612.31413,   0.     , 323.51898,
           0.     , 611.02197, 241.9    ,
           0.     ,   0.     ,   1.     ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.081523, -0.173902, 1.2e-3, -0.000803, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0.,
         0., 1., 0.,
         0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [615.10021,   0.     , 322.8    ,   0.     ,
           0.     , 616.20001, 242.1    ,   0.     ,
           0.     ,   0.     ,   1.     ,   0.     ]
"""


def picture_grid(camera: CameraModel) -> FloatArray:
    """Pixels over the whole picture, its outermost edges included."""
    columns = np.linspace(-0.5, camera.width_px - 0.5, 81)
    rows = np.linspace(-0.5, camera.height_px - 0.5, 47)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def points_in_view(camera: CameraModel) -> FloatArray:
    """Points at 0.3 to 20 m whose images cover the picture."""
    rng = np.random.default_rng(7)
    rays = camera.unproject(picture_grid(camera))
    return rays * rng.uniform(0.3, 20.0, (*rays.shape[:-1], 1))


@every_camera
def test_project_agrees_with_opencv(camera: CameraModel) -> None:
    points = points_in_view(camera)
    flat, still, coefficients = points.reshape(-1, 1, 3), np.zeros(3), np.array(camera.distortion)
    if camera.distortion_model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(flat, still, still, camera.matrix, coefficients)
    else:
        expected, _ = cv2.projectPoints(flat, still, still, camera.matrix, coefficients)
    np.testing.assert_allclose(camera.project(points), expected.reshape(*points.shape[:-1], 2), rtol=0, atol=1e-9)


@every_camera
def test_jacobian_agrees_with_finite_differences(camera: CameraModel) -> None:
    points = points_in_view(camera)
    pixels, jacobian = camera.project_with_jacobian(points)
    np.testing.assert_array_equal(pixels, camera.project(points))
    for axis in range(3):
        step = 1e-6 * points[..., 2:] * np.eye(3)[axis]
        difference = (camera.project(points + step) - camera.project(points - step)) / (2e-6 * points[..., 2:])
        inside = np.isfinite(difference)
        assert inside.mean() > 0.99
        scale = np.abs(jacobian).max()
        np.testing.assert_allclose(jacobian[..., axis][inside], difference[inside], rtol=1e-6, atol=1e-8 * scale)


@every_camera
def test_every_pixel_has_a_ray_that_leads_back(camera: CameraModel) -> None:
    pixels = picture_grid(camera)
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose(camera.project(rays), pixels, rtol=0, atol=1e-9)
    np.testing.assert_allclose(camera.unproject(camera.project(3.0 * rays)), rays, rtol=0, atol=1e-10)


@every_camera
def test_the_axis_itself(camera: CameraModel) -> None:
    centre = np.array([camera.cx_px, camera.cy_px])
    pixels, jacobian = camera.project_with_jacobian([0.0, 0.0, 2.0])
    np.testing.assert_allclose(pixels, centre, atol=1e-12)
    np.testing.assert_allclose(jacobian, [[camera.fx_px / 2, 0, 0], [0, camera.fy_px / 2, 0]], atol=1e-9)
    np.testing.assert_allclose(camera.unproject(centre), [0, 0, 1], atol=1e-15)


@every_camera
def test_points_without_an_image_are_nan_and_leave_others_alone(camera: CameraModel) -> None:
    points = [[0.1, 0.1, 1.0], [0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 0.0], [np.nan, 0, 1], [1.0, 0.0, 1e-320]]
    pixels, jacobian = camera.project_with_jacobian(points)
    np.testing.assert_array_equal(np.isfinite(pixels[:, 0]), [True, False, False, False, False, False])
    np.testing.assert_array_equal(np.isfinite(jacobian).all(axis=(1, 2)), np.isfinite(pixels[:, 0]))


@pytest.mark.parametrize("camera", [PLUMB_BOB, RATIONAL, EQUIDISTANT], ids=lambda camera: camera.name)
def test_a_pixel_no_ray_reaches_is_nan(camera: CameraModel) -> None:
    rays = camera.unproject([[1e5, 0.0], [600.0, 300.0], [-1e5, 1e5], [np.nan, 0.0]])
    np.testing.assert_array_equal(np.isnan(rays).all(axis=-1), [True, False, True, True])


def test_images_grow_outwards_up_to_the_limit() -> None:
    angles = np.radians(np.linspace(0.0, 89.5, 500))
    points = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=-1)
    for camera in CAMERAS:
        columns = camera.project(points)[:, 0]
        seen = np.isfinite(columns)
        assert 0 < seen.sum() < len(angles)
        assert not np.any(seen[np.argmin(seen) :])  # once out of sight, out of sight
        assert np.all(np.diff(columns[seen]) > 0)


@every_camera
@pytest.mark.parametrize("factor", [0.5, 2.0, 0.37])
def test_scaled_keeps_the_pictures_edges(camera: CameraModel, factor: float) -> None:
    scaled = camera.resize(factor)
    rays = camera.unproject(picture_grid(camera))
    edges = picture_grid(scaled)
    # The same share of the way across the picture, counted from its edge, is the same ray.
    np.testing.assert_allclose(scaled.project(rays), edges, rtol=0, atol=1e-9)


def test_scaled_moves_the_centre_as_opencv_resizes() -> None:
    picture = np.zeros((480, 640), np.float32)
    picture[200:220, 300:340] = 1.0  # its centre: (319.5, 209.5)
    small = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    rows, columns = np.nonzero(small)
    centred = replace(UNDISTORTED, cx_px=319.5, cy_px=209.5).resize(0.5)
    assert (centred.cx_px, centred.cy_px) == (columns.mean(), rows.mean())


@every_camera
def test_yaml_gives_back_every_bit(camera: CameraModel, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    write_camera_yaml(camera, path)
    assert read_camera_yaml(path) == camera
    assert [entry.name for entry in tmp_path.iterdir()] == ["camera.yaml"]


def test_reads_what_ros_writes(tmp_path: Path) -> None:
    path = tmp_path / "ost.yaml"
    path.write_text(ROS_FILE)
    assert read_camera_yaml(path) == CameraModel(
        "narrow_stereo",
        640,
        480,
        612.31413,
        611.02197,
        323.51898,
        241.9,
        "plumb_bob",
        (0.081523, -0.173902, 0.0012, -0.000803, 0.0),
    )


@pytest.mark.parametrize(
    ("model", "data", "expected"),
    [
        ("plumb_bob", "[0.1, 0.2, 0.3, 0.4]", (0.1, 0.2, 0.3, 0.4, 0.0)),
        ("rational_polynomial", "[1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0]", (1, 2, 3, 4, 5, 6, 7, 8)),
    ],
)
def test_short_and_padded_coefficients(tmp_path: Path, model: str, data: str, expected: tuple[float, ...]) -> None:
    path = tmp_path / "camera.yaml"
    text = ROS_FILE.replace("[0.081523, -0.173902, 1.2e-3, -0.000803, 0.000000]", data)
    path.write_text(text.replace("plumb_bob", model))
    assert read_camera_yaml(path).distortion == expected


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("image_width: 640", "", ["image_width", "missing"]),
        ("image_width: 640", "image_width: 0", ["image_width", "0", "greater than 0"]),
        ("image_width: 640", "image_width: wide", ["image_width", "'wide'", "integer"]),
        ("612.31413", "-612.3", ["fx_px", "-612.3", "above 0"]),
        ("612.31413", ".nan", ["camera_matrix.data[0]", "nan", "finite"]),
        ("612.31413,   0.     ", "612.31413,   0.5", ["camera_matrix.data", "0.5", "skew"]),
        ("612.31413, ", "", ["camera_matrix.data", "9 items"]),
        ("plumb_bob", "thin_prism", ["distortion_model", "'thin_prism'", "equidistant"]),
        ("0.000803, 0.000000", "0.000803, 0.0, 0.1", ["distortion", "6 coefficients", "needs 5"]),
        ("0.081523, -0.173902, 1.2e-3", "0.081523", ["distortion", "3 coefficients", "needs 5"]),
        ("0.081523", "oops", ["distortion_coefficients.data[0]", "'oops'", "number"]),
        ("image_height: 480", "image_width: 480", ["image_width", "twice", "line 2"]),
        ("image_width: 640", "image_width: [640", ["not valid YAML", "line"]),
    ],
)
def test_a_bad_file_gives_one_clear_line(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    path = tmp_path / "camera.yaml"
    assert old in ROS_FILE
    path.write_text(ROS_FILE.replace(old, new))
    with pytest.raises(CalibError) as caught:
        read_camera_yaml(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in [str(path), *words]:
        assert word in message


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, ["cannot be read"]), (b"", ["field: value"]), (b"\xff\xfe\x00", ["UTF-8"]), (b"- 1\n- 2\n", ["[1, 2]"])],
)
def test_a_file_that_is_none_gives_one_clear_line(tmp_path: Path, content: bytes | None, words: list[str]) -> None:
    path = tmp_path / "camera.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CalibError) as caught:
        read_camera_yaml(path)
    for word in [str(path), *words]:
        assert word in str(caught.value)


KALIBR_FILE = """\
cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.003, 0.0004]
  distortion_model: equidistant
  intrinsics: [461.6, 460.3, 362.7, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""


@pytest.mark.parametrize(
    ("theirs", "ours", "coefficients"),
    [
        ("equidistant", "equidistant", (-0.01, 0.02, -0.003, 0.0004)),
        ("radtan", "plumb_bob", (-0.01, 0.02, -0.003, 0.0004, 0.0)),
    ],
)
def test_reads_what_kalibr_writes(tmp_path: Path, theirs: str, ours: str, coefficients: tuple[float, ...]) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR_FILE.replace("equidistant", theirs))
    assert read_camera_yaml(path) == CameraModel("cam0", 752, 480, 461.6, 460.3, 362.7, 248.1, ours, coefficients)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pinhole", "omni", ["cam0", "omni", "pinhole"]),
        ("equidistant", "fov", ["fov", "radtan"]),
        ("[461.6, ", "[", ["intrinsics", "3 numbers"]),
        ("0.0004]", "0.0004, 1.0]", ["distortion_coeffs", "5 numbers"]),
        ("resolution: [752, 480]", "", ["resolution", "missing"]),
        ("cam0:", "cam1: {camera_model: pinhole}\ncam0:", ["2 cameras", "cam0"]),
        ("cam0:", "1: {}\ncam1: {camera_model: pinhole}\ncam0:", ["2 cameras", "cam0"]),
    ],
)
def test_a_kalibr_file_that_is_no_camera_of_ours_gives_one_clear_line(
    tmp_path: Path, old: str, new: str, words: list[str]
) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR_FILE.replace(old, new))
    with pytest.raises(CalibError) as caught:
        read_camera_yaml(path)
    for word in [str(path), *words]:
        assert word in str(caught.value)


def test_what_a_calibration_says_of_its_errors_stands_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    estimate = CameraEstimate(
        n_views=30, n_corners=1200, corner_sigma_px=0.01, expected_error_px=0.02, parameters=["fx_px", "fy_px"],
        sigmas=[0.1, 0.2], covariance=[0.01, 0.005, 0.005, 0.04],
    )  # fmt: skip
    write_camera_yaml(UNDISTORTED, path, estimate)
    assert read_camera_yaml(path) == UNDISTORTED
    assert read_estimate(path) == estimate
    np.testing.assert_array_equal(estimate.matrix(), [[0.01, 0.005], [0.005, 0.04]])
    write_camera_yaml(UNDISTORTED, path)
    assert read_estimate(path) is None


@pytest.mark.parametrize(
    "covariance", ["[0.01, 0.03, 0.03, 0.04]", "[-0.01, 0.0, 0.0, 0.04]", "[0.02, 0.0, 0.0, 0.04]"]
)
def test_errors_that_cannot_be_are_refused(covariance: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    estimate = (
        "groundsbot_estimate: {n_views: 30, n_corners: 1200, corner_sigma_px: 0.01, expected_error_px: 0.02, "
        f"parameters: [fx_px, fy_px], sigmas: [0.1, 0.2], covariance: {covariance}}}\n"
    )
    path.write_text(estimate)
    with pytest.raises(CalibError, match=r"camera.yaml: .*covariance must have the squared sigmas on its diagonal"):
        read_estimate(path)
