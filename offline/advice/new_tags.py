"""Tags that could be hung up: places beside the way, and what the same drives would have told had a tag been there.

Where walls are is not known. So a place lies as far from the way as a tag of the map is seen from, ahead to the left or
to the right, and faces the robot there; it is read from where the robots' cameras have it in view as they have the
tags of the map.
"""

from collections.abc import Iterator
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.advice.information_gain import InformationGain, marginal_information
from groundsbot.offline.advice.passes import SIGHTING_GAP_M
from groundsbot.offline.sam import Columns, Graph, ReadingFactors, State

MOST_TAGS: Final = 18
# Places along the way from which these are chosen, and keyframes among which their viewers are sought.
_MOST_PLACES: Final = 160
_MOST_VIEWERS: Final = 20_000
_LEAST_SPACING_M: Final = 1.0
# A tag printed on a wall is not read from farther to its side.
MOST_SLANT_RAD: Final = np.radians(65.0)
# Readings of one passing by share most of what they tell: some stand for all, so far along it.
_WITHIN_SIGHTING: Final = np.array([0.25, 0.75])
_MOST_SIGHTINGS: Final = 3
_NEAREST_IN_RANGE: Final = 9


class TagViews(NamedTuple):
    """How the tags of a map were seen, about the sensor."""

    near_m: float
    far_m: float
    half_angle_rad: float
    typical_m: float
    typical_rad: float
    n_a_passage: float  # readings
    range_m: FloatArray  # (M,) of all readings, rising
    variance: FloatArray  # (M, 2) of range and bearing


class TagSite(NamedTuple):
    """Where a tag could hang, and the poses that would read it: some for each passing by."""

    segment: int
    keyframe: int  # beside which it lies
    position_m: FloatArray  # (2,)
    viewers: IntArray  # (k,) poses
    n_passages: int


class DrivePaths(NamedTuple):
    """What the places are laid along and seen from."""

    graph: Graph
    state: State
    ways: list[FloatArray]
    sensors: FloatArray  # (P, 3) where what reads the tags is at each pose, in map
    example: IntArray  # (P,) a reading of the same segment; -1 where it has none


def drives_of(graph: Graph, state: State, ways: list[FloatArray]) -> DrivePaths:
    """Of a solved component."""
    mounts = [segment.T_base_camera if segment.readings.in_camera.any() else np.zeros(3) for segment in graph.segments]
    lengths = [len(segment.stamps_ns) for segment in graph.segments]
    sensors = se2.compose(state.poses, np.repeat(np.array(mounts), lengths, axis=0))
    example = np.searchsorted(graph.problem.readings.pose, graph.first_pose)
    example = np.where([len(segment.readings) > 0 for segment in graph.segments], example, -1)
    return DrivePaths(graph, state, ways, sensors, np.repeat(example, lengths))


def view_of(drives: DrivePaths, n_sightings: int) -> TagViews:
    """How the readings of a map came about; there must be some."""
    readings = drives.graph.problem.readings
    sight = se2.apply(se2.inverse(drives.sensors[readings.pose]), drives.state.tags[readings.tag])
    range_m, bearing_rad = np.hypot(*sight.T), np.arctan2(sight[:, 1], sight[:, 0])
    covariance = np.linalg.inv(readings.whitening.swapaxes(-1, -2) @ readings.whitening)
    cos, sin = np.cos(bearing_rad), np.sin(bearing_rad)
    along, across = np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)
    radial = np.where(readings.polar, covariance[:, 0, 0], np.einsum("mi,mij,mj->m", along, covariance, along))
    tangential = np.einsum("mi,mij,mj->m", across, covariance, across) / np.maximum(range_m, 1e-6) ** 2
    variance = np.column_stack([radial, np.where(readings.polar, covariance[:, 1, 1], tangential)])
    order = np.argsort(range_m, kind="stable")
    near_m, typical_m, far_m = np.quantile(range_m, [0.05, 0.5, 0.95]).tolist()
    typical_rad, widest_rad = np.quantile(np.abs(bearing_rad), [0.5, 0.95]).tolist()
    n = len(range_m) / max(n_sightings, 1)
    return TagViews(near_m, far_m, widest_rad, typical_m, typical_rad, n, range_m[order], variance[order])


def places_of(drives: DrivePaths, view: TagViews, most: int = MOST_TAGS) -> list[TagSite]:
    """Places beside the ways, at most so many, of which a part lies about the first start and the rest far from tags.

    Everything is seen from the first start, so that where no tag holds its heading all of the map turns about it. Of
    the rest those that are passed more than once go first: there a tag joins what nothing joined.
    """
    spacing_m = max(_LEAST_SPACING_M, 2.0 * sum(float(way[-1]) for way in drives.ways) / _MOST_PLACES)
    beside = {
        (segment, int(keyframe))
        for segment, way in enumerate(drives.ways)
        for keyframe in np.searchsorted(way, np.arange(0.0, float(way[-1]), spacing_m))
    }
    start_m = np.arange(0.0, view.far_m, _LEAST_SPACING_M)
    at_start = {(0, int(keyframe)) for keyframe in np.searchsorted(drives.ways[0][:-1], start_m)}
    first = list(islice(_places_with_two_views(drives, view, at_start), most // 3))
    others = list(_places_with_two_views(drives, view, beside - at_start))
    again = [place for place in others if place.n_passages > 1]
    return first + _spread_over(again or others, drives.state.tags, most - len(first))


def _places_with_two_views(drives: DrivePaths, view: TagViews, where: set[tuple[int, int]]) -> Iterator[TagSite]:
    """Of places beside some segments and keyframes those that more than one pose views."""
    for segment, keyframe in sorted(where):
        for side in (1.0, -1.0):
            place = place_beside(drives, view, segment, keyframe, side)
            if len(place.viewers) > 1:
                yield place


def place_beside(drives: DrivePaths, view: TagViews, segment: int, keyframe: int, side: float) -> TagSite:
    """The place ahead of a keyframe, to its left (+1) or right (-1).

    Nobody views it where the keyframe's segment has no readings: how its robot would read it, nothing tells.
    """
    pose = int(drives.graph.first_pose[segment]) + keyframe
    sensor = drives.sensors[pose]
    if drives.example[pose] < 0:
        return TagSite(segment, keyframe, sensor[:2], np.zeros(0, dtype=np.int64), 0)
    angle = side * view.typical_rad
    position_m = se2.apply(sensor, view.typical_m * np.array([np.cos(angle), np.sin(angle)]))
    step = -(-len(drives.sensors) // _MOST_VIEWERS)
    away_m = np.abs(drives.sensors[::step, :2] - position_m).max(axis=1)
    near = step * np.flatnonzero((away_m <= view.far_m) & (drives.example[::step] >= 0))
    seen = near[is_in_view(drives.sensors[near], position_m, sensor[:2] - position_m, view)]
    sightings = _passages(drives, seen, least=view.n_a_passage / step)
    beside = np.array([pose], dtype=np.int64)
    viewers = [part[(_WITHIN_SIGHTING * (len(part) - 1)).round().astype(int)] for part in sightings]
    return TagSite(segment, keyframe, position_m, np.unique(np.concatenate([beside, *viewers])), len(sightings))


def is_in_view(sensors: FloatArray, position_m: FloatArray, face: FloatArray, view: TagViews) -> BoolArray:
    """(P,) which sensors have a tag at a place in view that faces along a vector."""
    sight = se2.apply(se2.inverse(sensors), position_m)
    range_m, bearing_rad = np.hypot(*sight.T), np.arctan2(sight[:, 1], sight[:, 0])
    towards = sensors[:, :2] - position_m
    slant = (towards @ face) / np.maximum(range_m * np.hypot(*face), 1e-9)
    near_enough = (range_m >= view.near_m) & (range_m <= view.far_m)
    return np.asarray(near_enough & (np.abs(bearing_rad) <= view.half_angle_rad) & (slant >= np.cos(MOST_SLANT_RAD)))


def gain_of_place(drives: DrivePaths, view: TagViews, place: TagSite, seen: BoolArray | None = None) -> InformationGain:
    """What a tag there would have told of the poses that read it, and of the calibration.

    Args:
        drives: of `drives_of`.
        view: of `view_of`.
        place: of `places_of`.
        seen: (k,) which of its viewers have it in view; all where None.
    """
    of_map = drives.graph.problem.columns
    poses = place.viewers if seen is None else place.viewers[seen]
    state = drives.state
    extended = State(state.poses, np.concatenate([state.tags, place.position_m[None]]), state.calibration)
    own, columns = _own_columns(of_map, poses)
    readings = _readings(drives, view, place, poses)
    return marginal_information((readings.linearise(extended, own),), 2, columns)


def _own_columns(of_map: Columns, poses: IntArray) -> tuple[Columns, IntArray]:
    """Columns of one new tag, then of the map's poses and calibration; and which those are there."""
    wanted, free = of_map.poses[poses], of_map.calibration >= 0
    is_free = wanted >= 0
    by_pose = np.full(of_map.poses.shape, -1)
    by_pose[poses] = np.where(is_free, 1 + np.cumsum(is_free).reshape(wanted.shape), -1)
    n_poses = int(is_free.sum())
    by_tag = np.full((len(of_map.tags) + 1, 2), -1)
    by_tag[-1] = 0, 1
    by_calibration = np.where(free, 1 + n_poses + np.cumsum(free), -1)
    columns = np.concatenate([wanted[is_free], of_map.calibration[free]])
    return Columns(by_pose, by_tag, by_calibration, 2 + len(columns)), columns


def _readings(drives: DrivePaths, view: TagViews, place: TagSite, poses: IntArray) -> ReadingFactors:
    """As their like were read: so many of each passing by, with the sigmas of readings at that range."""
    readings, like = drives.graph.problem.readings, drives.example[poses]
    sight = se2.apply(se2.inverse(drives.sensors[poses]), place.position_m)
    value = np.column_stack([np.hypot(*sight.T), np.arctan2(sight[:, 1], sight[:, 0])])
    at = np.searchsorted(view.range_m, value[:, 0])
    first = np.clip(at - _NEAREST_IN_RANGE // 2, 0, max(len(view.range_m) - _NEAREST_IN_RANGE, 0))
    variance = np.array([view.variance[i : i + _NEAREST_IN_RANGE].mean(axis=0) for i in first])
    n_each = view.n_a_passage * place.n_passages / len(place.viewers)
    tag = np.full(len(poses), len(drives.state.tags))
    return ReadingFactors(
        pose=poses,
        tag=tag,
        value=value,
        polar=np.ones(len(tag), dtype=np.bool_),
        whitening=np.sqrt(max(n_each, 1.0) / variance)[:, :, None] * np.eye(2),
        mount=readings.mount[like],
        mount_parameters=readings.mount_parameters[like],
        scale_parameter=readings.scale_parameter[like],
        by_camera=np.zeros((len(tag), *readings.by_camera.shape[1:])),
        camera_parameters=readings.camera_parameters[like],
    )


def _passages(drives: DrivePaths, poses: IntArray, least: float) -> list[IntArray]:
    """Rising poses, parted where a segment ends or drives on before it comes back; not more than a few, from all over.

    A glimpse is not counted on: a passing by has the tag in view from as many poses as read a tag on average.
    """
    if not len(poses):
        return []
    along_m = np.concatenate(drives.ways)[poses]
    segment = np.searchsorted(drives.graph.first_pose, poses, side="right")
    parts = np.split(poses, np.flatnonzero((np.diff(segment) != 0) | (np.diff(along_m) > SIGHTING_GAP_M)) + 1)
    parts = [part for part in parts if len(part) >= least]
    if len(parts) <= _MOST_SIGHTINGS:
        return parts
    return [parts[i] for i in np.linspace(0, len(parts) - 1, _MOST_SIGHTINGS).round().astype(int)]


def _spread_over(places: list[TagSite], tags_m: FloatArray, most: int) -> list[TagSite]:
    """Each as far as can be from the tags and from those chosen before."""
    if len(places) <= most:
        return places
    where = np.array([place.position_m for place in places])
    away_m, _ = cKDTree(tags_m).query(where)
    chosen: list[int] = []
    for _ in range(most):
        chosen.append(int(np.argmax(away_m)))
        away_m = np.minimum(away_m, np.hypot(*(where - where[chosen[-1]]).T))
    return [places[i] for i in chosen]
