"""Rendered pictures against geometry: corners to hundredths of a pixel, motion, shutter, occlusion, light."""

import numpy as np
import pytest

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.robot import Mount
from groundsbot.fixtures.drives.true_motion import Drive
from groundsbot.fixtures.pictures.render import Renderer
from groundsbot.fixtures.pictures.textures import ByteArray
from groundsbot.fixtures.pictures.visibility import Eye, sightings
from groundsbot.fixtures.worlds.scene import Faces, Tags, faces_of, tags_of
from groundsbot.fixtures.worlds.world import Box, Pictures, Wall, World, WorldTag
from groundsbot.onboard.detection.tag_detector import Detection, TagDetector

SIZE_M = 0.15
STRAIGHT = CameraModel("c", 640, 480, 600.0, 600.0, 319.5, 239.5, "plumb_bob", (0.0,) * 5)
BENT = CameraModel("c", 640, 480, 600.0, 605.0, 322.0, 236.0, "plumb_bob", (-0.2, 0.06, 0.001, -0.0005, 0.0))
FISHEYE = CameraModel("c", 640, 480, 420.0, 420.0, 320.0, 240.0, "equidistant", (0.02, -0.005, 0.001, 0.0))
MOUNT = Mount(x_m=0.1, y_m=0.03, z_m=0.4, yaw_rad=0.02, pitch_rad=0.03, roll_rad=-0.02)
CLEAN = Pictures(
    defocus_px=0.0, gamma=1.0, vignetting=0.0, bloom=0.0, read_noise_electrons=0.0, full_well_electrons=1e9
)
SHARP = CLEAN.model_copy(update={"defocus_px": 0.7})
MIDDLE_NS = 500_000_000


def made_world(tags: list[WorldTag], boxes: list[Box] | None = None) -> World:
    wall = Wall(line_m=[[8.0, -6.0], [8.0, 6.0]])
    return World.model_construct(
        name="made", robots=[], walls=[wall], boxes=boxes or [], tags=tags, ceiling_height_m=2.8
    )


def scene(world: World) -> tuple[Tags, Faces]:
    return tags_of(world.tags, np.array([tag.size_m for tag in world.tags])), faces_of(world)


def moving(speed_m_s: float = 0.0, turn_rad_s: float = 0.0) -> Drive:
    """A second of motion, its middle at the origin, heading along x."""
    seconds = np.linspace(-0.5, 0.5, 101)
    theta = turn_rad_s * seconds
    if turn_rad_s == 0.0:
        poses = np.stack([speed_m_s * seconds, 0 * seconds, theta], axis=-1)
    else:
        radius = speed_m_s / turn_rad_s
        poses = np.stack([radius * np.sin(theta), radius * (1 - np.cos(theta)), theta], axis=-1)
    return Drive((np.arange(101) * 10_000_000).astype(np.int64), poses, seconds, seconds)


def taken(
    world: World, model: CameraModel, settings: Pictures, drive: Drive | None = None, readout_s: float = 0.0
) -> tuple[ByteArray, dict[int, FloatArray]]:
    """A picture, and where the tags' corners are in it."""
    tags, faces = scene(world)
    eye = Eye(model, MOUNT.T_base_camera.as_matrix(), readout_s, settings.exposure_s)
    drive = drive or moving()
    picture = Renderer(settings, 2.8, tags, faces, eye).picture(drive, MIDDLE_NS, np.random.default_rng(1))
    limits = World.model_fields["detection"].default.model_copy(
        update={"smallest_side_px": 5.0, "largest_obliqueness_deg": 85.0, "smear_weight": 0.0}
    )
    exact = World.model_fields["noise"].default.model_copy(update={"sigma_corner_px": 0.0})
    world = world.model_copy(update={"detection": limits, "noise": exact})
    seen = sightings(world, tags, faces, eye, drive, np.array([MIDDLE_NS]), np.random.default_rng(0))
    return picture, dict(zip(tags.tag_id[seen.tag].tolist(), seen.corners_px, strict=True))


def detected(picture: ByteArray, decimate: float = 1.0) -> dict[int, Detection]:
    return {each.tag_id: each for each in TagDetector(library="pyapriltags", quad_decimate=decimate).detect(picture)}


def shelf(count: int = 6) -> list[WorldTag]:
    """Tags at many angles and distances, none hiding another."""
    rng = np.random.default_rng(7)
    places = [
        (1.3, 0.35, 0.55),
        (1.5, -0.35, 0.3),
        (1.8, 0.1, 0.75),
        (2.0, 0.75, 0.15),
        (2.2, -0.8, 0.7),
        (2.4, 0.1, 0.2),
    ]
    return [
        WorldTag(
            tag_id=10 + index,
            position_m=list(place),
            yaw_deg=180.0 + float(rng.uniform(-45, 45)),
            pitch_deg=float(rng.uniform(-25, 25)),
            roll_deg=float(rng.uniform(-180, 180)),
        )
        for index, place in enumerate(places[:count])
    ]


@pytest.mark.parametrize("model", [STRAIGHT, BENT, FISHEYE], ids=["straight", "plumb_bob", "equidistant"])
def test_the_detector_finds_corners_where_they_are_projected(model: CameraModel) -> None:
    errors = []
    for shift in (0.0, 0.11, 0.23):
        tags = [
            tag.model_copy(update={"position_m": [tag.position_m[0] - shift, *tag.position_m[1:]]}) for tag in shelf()
        ]
        picture, expected = taken(made_world(tags), model, SHARP)
        found = detected(picture)
        errors += [found[tag].corners_px - corners for tag, corners in expected.items() if tag in found]
    all_errors = np.array(errors)
    assert len(errors) >= 12
    # The detector's own scatter on small and slanted tags; a renderer that is off shows in the mean.
    assert np.sqrt((all_errors**2).mean()) < 0.07
    assert np.abs(all_errors.mean(axis=(0, 1))).max() < 0.02


def test_edges_lie_to_hundredths_of_a_pixel_where_geometry_has_them() -> None:
    """The dark area of an upright tag's border tells its width and place, whatever a detector thinks."""
    distance_m = 0.6
    width_errors, place_errors = [], []
    for seed, offset_m in enumerate(np.linspace(0.0, 0.002, 12)):
        tag = WorldTag(tag_id=0, position_m=[distance_m + 0.1, 0.03 + float(offset_m), 0.4], yaw_deg=180.0)
        level = Mount(x_m=0.1, y_m=0.03, z_m=0.4)
        tags, faces = scene(made_world([tag]))
        eye = Eye(STRAIGHT, level.T_base_camera.as_matrix(), 0.0, 0.008)
        picture = Renderer(CLEAN, 2.8, tags, faces, eye).picture(moving(), MIDDLE_NS, np.random.default_rng(seed))
        # One cell of 0.15 / 8 m; the top border's rows, across the tag's whole width.
        cell_px = 600.0 * SIZE_M / 8 / distance_m
        top = 239.5 - 4 * cell_px
        rows = slice(int(np.ceil(top + 0.1 * cell_px)), int(top + 0.9 * cell_px))
        left, right = (319.5 - 600.0 * (offset_m + side * SIZE_M / 2) / distance_m for side in (1, -1))
        span = slice(int(left - 0.5 * cell_px), int(right + 0.5 * cell_px))
        light = picture[rows, span].astype(np.float64).mean(axis=0)
        white, black = light[:5].mean(), light[20:-20].mean()
        dark = (white - light) / (white - black)
        width_errors.append(dark.sum() - (right - left))
        place_errors.append((dark * np.arange(span.start, span.stop)).sum() / dark.sum() - (left + right) / 2)
    assert np.abs(width_errors).max() < 0.03
    assert np.abs(place_errors).max() < 0.02
    assert abs(np.mean(width_errors)) < 0.01
    assert abs(np.mean(place_errors)) < 0.005


def test_a_tag_is_seen_from_its_front_and_in_line_of_sight_only() -> None:
    front = WorldTag(tag_id=1, position_m=[2.0, 0.4, 0.4], yaw_deg=180.0)
    back = WorldTag(tag_id=2, position_m=[2.0, -0.6, 0.4], yaw_deg=0.0)
    behind_box = WorldTag(tag_id=3, position_m=[2.5, 0.0, 0.4], yaw_deg=180.0)
    above_box = WorldTag(tag_id=4, position_m=[2.5, 0.05, 0.9], yaw_deg=180.0)
    box = Box(centre_m=[1.5, 0.0], size_m=[0.2, 0.3, 0.5])
    picture, expected = taken(made_world([front, back, behind_box, above_box], [box]), STRAIGHT, SHARP)
    assert set(expected) == {1, 4}
    assert set(detected(picture)) == {1, 4}


def test_a_turning_robot_smears_tags_about_their_place_in_the_middle_of_the_exposure() -> None:
    tag = WorldTag(tag_id=5, position_m=[0.9, 0.0, 0.4], yaw_deg=180.0)
    slow = SHARP.model_copy(update={"exposure_s": 0.01})
    still, expected = taken(made_world([tag]), STRAIGHT, slow)
    turning, same = taken(made_world([tag]), STRAIGHT, slow, moving(turn_rad_s=1.0))
    np.testing.assert_allclose(same[5], expected[5], atol=1e-6)
    np.testing.assert_allclose(detected(turning)[5].corners_px, expected[5], atol=0.35)
    around = np.s_[180:300, 250:380]
    sharpest = [np.abs(np.diff(picture[around].astype(np.float64), axis=1)).max() for picture in (still, turning)]
    assert sharpest[1] < 0.45 * sharpest[0]  # six pixels of smear


def test_each_row_of_a_rolling_shutter_has_its_own_time() -> None:
    tags = [
        WorldTag(tag_id=6, position_m=[1.2, 0.2, 0.7], yaw_deg=180.0),
        WorldTag(tag_id=7, position_m=[1.2, 0.2, 0.15], yaw_deg=180.0),
    ]
    quick = SHARP.model_copy(update={"exposure_s": 0.0005})
    picture, expected = taken(made_world(tags), STRAIGHT, quick, moving(turn_rad_s=0.8, speed_m_s=0.4), readout_s=0.03)
    _, whole = taken(made_world(tags), STRAIGHT, quick, moving(turn_rad_s=0.8, speed_m_s=0.4))
    found = detected(picture)
    for tag in (6, 7):
        np.testing.assert_allclose(found[tag].corners_px, expected[tag], atol=0.15)
        assert np.abs(whole[tag] - expected[tag]).max() > 2.0


def test_light_becomes_numbers_as_the_sensor_is_set() -> None:
    world = made_world([])
    clean, _ = taken(world, STRAIGHT, CLEAN)
    noisy, _ = taken(
        world, STRAIGHT, CLEAN.model_copy(update={"read_noise_electrons": 40.0, "full_well_electrons": 4000.0})
    )
    bright, _ = taken(world, STRAIGHT, CLEAN.model_copy(update={"gamma": 2.2}))
    dim, _ = taken(world, STRAIGHT, CLEAN.model_copy(update={"vignetting": 0.5}))
    glowing, _ = taken(world, STRAIGHT, CLEAN.model_copy(update={"bloom": 0.3}))
    assert clean.std() > 20  # not flat grey
    assert (clean == 255).any()  # lamps saturate
    noise = (noisy.astype(np.float64) - clean)[(clean > 100) & (clean < 150)] / 255.0
    assert noise.std() == pytest.approx(np.sqrt(0.49 * 4000 + 40.0**2) / 4000, rel=0.05)
    assert abs(noise.mean()) < 2e-3
    np.testing.assert_allclose(bright, np.rint(255 * (clean / 255.0) ** (1 / 2.2)), atol=4)
    assert dim[0, 0] == pytest.approx(clean[0, 0] * 0.5, abs=2)
    assert dim[240, 320] == pytest.approx(clean[240, 320], abs=2)
    spilt = glowing.astype(int) - clean
    assert spilt.min() >= -1
    assert spilt.max() > 10
