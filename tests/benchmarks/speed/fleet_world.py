"""A town for fleets of any size: square blocks, roads between them, tags on thin boards beside the roads."""

import math
from typing import Any, Final

import numpy as np

from groundsbot.fixtures.worlds.world import Box, Camera, Pictures, Route, Start, Waypoint, World, WorldRobot, WorldTag

PITCH_M: Final = 9.0  # from one crossing to the next
ROAD_WIDTH_M: Final = 3.0
TAG_OFFSET_M: Final = 1.2  # from the middle of the road: no robot drives through a tag
CORNER_RADIUS_M: Final = 1.0
SPEED_M_S: Final = 0.8
PICTURE_RATE_HZ: Final = 15.0  # at that speed every picture of a moving robot becomes a keyframe
# More than the 587 of the family tag36h11: without pictures nothing is drawn or detected, and an id is but a number.
MOST_TAGS: Final = 3_000
_ROAD_PER_TAG_M: Final = 2.0
_TAG_FREE_M: Final = 1.5  # from the middle of a crossing
_WAYS: Final = ((1, 0), (0, 1), (-1, 0), (0, -1))  # by quarter turns
_CORNER_SAVES_M: Final = (2.0 - 0.5 * math.pi) * CORNER_RADIUS_M
# The robot and camera of the world nsh.
_ROBOT: Final[dict[str, Any]] = {
    "wheels": {
        "radius_left_m": 0.1,
        "radius_left_m_sigma": 0.0005,
        "radius_right_m": 0.1,
        "radius_right_m_sigma": 0.0005,
        "track_m": 0.508,
        "track_m_sigma": 0.00508,
        "ticks_per_turn": 4096,
    },
    "mount": {
        "x_m": 0.15,
        "x_m_sigma": 0.005,
        "y_m_sigma": 0.005,
        "z_m": 0.42,
        "z_m_sigma": 0.005,
        "roll_rad_sigma": 0.0035,
        "pitch_rad_sigma": 0.0035,
        "yaw_rad_sigma": 0.0087266,
    },
    "time_offset_s_sigma": 0.001,
    "tags": [{"family": "tag36h11", "default_size_m": 0.15, "sigma_size_m": 0.00075, "batch": "fleet"}],
}
_CAMERA: Final = Camera(
    width_px=1280, height_px=720, fx_px=902.4, fy_px=901.1, cx_px=643.2, cy_px=356.7,
    distortion=[-0.182, 0.071, 0.0006, -0.0004, 0.0],
)  # fmt: skip


def fleet_world(n_robots: int, n_keyframes: int, n_tags: int, seed: int) -> World:
    """Robots that drive at random from crossing to crossing, all over the same roads.

    Args:
        n_robots: one run each.
        n_keyframes: that each drive yields, or up to a block's more.
        n_tags: at most MOST_TAGS; the town grows with them.
        seed: of places and routes.
    """
    rng = np.random.default_rng(seed)
    n_crossings = max(3, round(math.sqrt(n_tags * _ROAD_PER_TAG_M / (2.0 * PITCH_M)) + 0.5))
    block_m = PITCH_M - ROAD_WIDTH_M
    return World(
        name="fleet",
        boxes=[
            Box(centre_m=[PITCH_M * (x + 0.5), PITCH_M * (y + 0.5)], size_m=[block_m, block_m, 2.5])
            for x in range(n_crossings - 1)
            for y in range(n_crossings - 1)
        ],
        tags=[_tag(rng, n_crossings, tag_id) for tag_id in range(n_tags)],
        robots=[
            WorldRobot(id=f"robot{i:02d}", robot=_ROBOT, camera=_CAMERA, route=_route(rng, n_crossings, n_keyframes))
            for i in range(n_robots)
        ],
        pictures=Pictures(rate_hz=PICTURE_RATE_HZ),
    )


def _tag(rng: np.random.Generator, n_crossings: int, tag_id: int) -> WorldTag:
    """Beside a road, looking along it."""
    block = int(rng.integers(0, n_crossings - 1))
    along_m = PITCH_M * block + float(rng.uniform(_TAG_FREE_M, PITCH_M - _TAG_FREE_M))
    across_m = PITCH_M * int(rng.integers(0, n_crossings)) + float(rng.choice([-TAG_OFFSET_M, TAG_OFFSET_M]))
    height_m = float(rng.uniform(0.3, 0.6))
    quarter = int(rng.integers(0, 4))
    place_m = [along_m, across_m, height_m] if quarter % 2 == 0 else [across_m, along_m, height_m]
    return WorldTag(tag_id=tag_id, position_m=place_m, yaw_deg=90.0 * quarter + float(rng.uniform(-20.0, 20.0)))


def _route(rng: np.random.Generator, n_crossings: int, n_keyframes: int) -> Route:
    """From crossing to crossing without turning round."""
    x, y, quarter = (int(rng.integers(0, n)) for n in (n_crossings, n_crossings, 4))
    start, driven_m, waypoints = (x, y), 0.0, list[Waypoint]()
    while driven_m < n_keyframes * SPEED_M_S / PICTURE_RATE_HZ:
        free = [
            (quarter + turn) % 4
            for turn in (0, 1, 3)
            if 0 <= x + _WAYS[(quarter + turn) % 4][0] < n_crossings
            and 0 <= y + _WAYS[(quarter + turn) % 4][1] < n_crossings
        ]
        before, quarter = quarter, int(rng.choice(free))
        driven_m += PITCH_M - (_CORNER_SAVES_M if waypoints and quarter != before else 0.0)
        x, y = x + _WAYS[quarter][0], y + _WAYS[quarter][1]
        waypoints.append(Waypoint(x_m=PITCH_M * x, y_m=PITCH_M * y, corner_radius_m=CORNER_RADIUS_M))
    heading = math.degrees(math.atan2(waypoints[0].y_m - PITCH_M * start[1], waypoints[0].x_m - PITCH_M * start[0]))
    return Route(
        start=Start(x_m=PITCH_M * start[0], y_m=PITCH_M * start[1], yaw_deg=heading),
        waypoints=waypoints,
        speed_m_s=SPEED_M_S,
    )
