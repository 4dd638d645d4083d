"""Candidate sites for new tags beside the driven paths, and what the same drives would have observed of a tag there.

The positions of walls are unknown. So a site lies as far from the path as the map's tags are typically observed from,
ahead to the left or to the right, and faces the robot there. It counts as observed from every pose where the robots'
cameras would have it in view as they have the tags of the map.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.advice.information_gain import InformationGain, marginal_information
from groundsbot.offline.advice.passes import TRACK_GAP_M
from groundsbot.offline.sam import Columns, Graph, ObservationFactors, State

MOST_TAGS: Final = 18
# Sites along the paths from which these are chosen, and keyframes that are checked for a view of them.
_MOST_PLACES: Final = 160
_MOST_VIEWERS: Final = 20_000
_LEAST_SPACING_M: Final = 1.0
# A tag on a wall is not detected at a larger angle to its normal.
MAX_INCIDENCE_RAD: Final = np.radians(65.0)
# Observations of one track share most of their information: those at these fractions of it stand for all.
_WITHIN_TRACK: Final = np.array([0.25, 0.75])
_MOST_TRACKS: Final = 3
_NEAREST_IN_RANGE: Final = 9
_AT_ONCE: Final = 2**16  # observations


class ViewStatistics(NamedTuple):
    """Where the tags of a map were observed, relative to the sensor, and with which variance."""

    near_m: float
    far_m: float
    half_angle_rad: float
    typical_m: float
    typical_rad: float
    observations_per_track: float  # observations
    range_m: FloatArray  # (M,) of all observations, ascending
    variance: FloatArray  # (M, 2) of range and bearing


class TagSite(NamedTuple):
    """Candidate position of a tag, and the poses that would observe it: some for each track."""

    segment: int
    keyframe: int  # the one that it lies beside
    position_m: FloatArray  # (2,)
    viewers: IntArray  # (k,) poses
    n_tracks: int


class DrivePaths(NamedTuple):
    """The driven paths along which sites are placed and from which they are observed."""

    graph: Graph
    state: State
    along_m: list[FloatArray]
    sensors: FloatArray  # (P, 3) pose of the tag sensor, the first of several cameras, at each keyframe, in map
    example_observation: IntArray  # (P,) index of an observation by it in the same segment; -1 if it has none


def drive_paths(graph: Graph, state: State, ways: list[FloatArray]) -> DrivePaths:
    """Return the driven paths of a solved component."""
    mounts, example = np.zeros((len(graph.segments), 3)), np.full(len(graph.segments), -1)
    observations = graph.problem.observations
    for i, segment in enumerate(graph.segments):
        of_first = np.flatnonzero(segment.observations.camera == 0)
        if len(of_first):
            example[i] = np.searchsorted(observations.pose, graph.first_pose[i]) + of_first[0]
            mounts[i] = observations.mount[example[i]]
    sensors, of_pose = np.empty((len(state.poses), 3)), np.empty(len(state.poses), dtype=np.int64)
    for i, first in enumerate(graph.first_pose.tolist()):
        own = slice(first, first + len(graph.segments[i].stamps_ns))
        sensors[own], of_pose[own] = se2.compose(state.poses[own], mounts[i]), example[i]
    return DrivePaths(graph, state, ways, sensors, of_pose)


def view_statistics(drives: DrivePaths, n_tracks: int) -> ViewStatistics:
    """Return statistics of the observations of a map; there must be some."""
    observations = drives.graph.problem.observations
    sights = np.empty((len(observations.pose), 4))
    for begin in range(0, len(sights), _AT_ONCE):  # bounds what is held besides the result
        some = slice(begin, begin + _AT_ONCE)
        sights[some] = _sights(drives.state, observations, some)
    range_m, angle_rad = sights[:, 0], np.abs(sights[:, 1])
    order = np.argsort(range_m, kind="stable")
    near_m, typical_m, far_m = np.quantile(range_m, [0.05, 0.5, 0.95]).tolist()
    typical_rad, widest_rad = np.quantile(angle_rad, [0.5, 0.95]).tolist()
    n = len(range_m) / max(n_tracks, 1)
    return ViewStatistics(near_m, far_m, widest_rad, typical_m, typical_rad, n, range_m[order], sights[order, 2:])


def _sights(state: State, observations: ObservationFactors, some: slice) -> FloatArray:
    """Return range, bearing, and the variance of each, (m, 4), of some observations, at the solution."""
    sensors = se2.compose(state.poses[observations.pose[some]], observations.mount[some])
    sight = se2.apply(se2.inverse(sensors), state.tags[observations.tag[some]])
    whitening, polar = observations.whitening[some], observations.polar[some]
    range_m, bearing_rad = np.hypot(*sight.T), np.arctan2(sight[:, 1], sight[:, 0])
    covariance = np.linalg.inv(whitening.swapaxes(-1, -2) @ whitening)
    cos, sin = np.cos(bearing_rad), np.sin(bearing_rad)
    along, across = np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)
    radial = np.where(polar, covariance[:, 0, 0], np.einsum("mi,mij,mj->m", along, covariance, along))
    tangential = np.einsum("mi,mij,mj->m", across, covariance, across) / np.maximum(range_m, 1e-6) ** 2
    return np.column_stack([range_m, bearing_rad, radial, np.where(polar, covariance[:, 1, 1], tangential)])


def tag_sites(drives: DrivePaths, view: ViewStatistics, most: int = MOST_TAGS) -> list[TagSite]:
    """Return at most `most` sites beside the paths, far from tags.

    Sites that are passed more than once come first: a tag there adds a loop closure.
    """
    spacing_m = max(_LEAST_SPACING_M, 2.0 * sum(float(way[-1]) for way in drives.along_m) / _MOST_PLACES)
    beside = {
        (segment, int(keyframe))
        for segment, way in enumerate(drives.along_m)
        for keyframe in np.searchsorted(way, np.arange(0.0, float(way[-1]), spacing_m))
    }
    sites = list(_sites_with_two_views(drives, view, beside))
    again = [place for place in sites if place.n_tracks > 1]
    return _farthest_points(again or sites, drives.state.tags, most)


def _sites_with_two_views(drives: DrivePaths, view: ViewStatistics, where: set[tuple[int, int]]) -> Iterator[TagSite]:
    """Yield the sites beside given (segment, keyframe) pairs that more than one pose would observe."""
    for segment, keyframe in sorted(where):
        for side in (1.0, -1.0):
            place = site_beside(drives, view, segment, keyframe, side)
            if len(place.viewers) > 1:
                yield place


def site_beside(drives: DrivePaths, view: ViewStatistics, segment: int, keyframe: int, side: float) -> TagSite:
    """Return the site ahead of a keyframe, to its left (+1) or right (-1).

    It has no viewers if the keyframe's segment has no observations, as nothing is known of its sensor then.
    """
    pose = int(drives.graph.first_pose[segment]) + keyframe
    sensor = drives.sensors[pose]
    if drives.example_observation[pose] < 0:
        return TagSite(segment, keyframe, sensor[:2], np.zeros(0, dtype=np.int64), 0)
    angle = side * view.typical_rad
    position_m = se2.apply(sensor, view.typical_m * np.array([np.cos(angle), np.sin(angle)]))
    step = -(-len(drives.sensors) // _MOST_VIEWERS)
    x_m, y_m = (np.abs(drives.sensors[::step, axis] - position_m[axis]) for axis in (0, 1))
    is_near = (x_m <= view.far_m) & (y_m <= view.far_m) & (drives.example_observation[::step] >= 0)
    near = step * np.flatnonzero(is_near)
    seen = near[is_in_view(drives.sensors[near], position_m, sensor[:2] - position_m, view)]
    tracks = _viewing_tracks(drives, seen, least=view.observations_per_track / step)
    beside = np.array([pose], dtype=np.int64)
    viewers = [part[(_WITHIN_TRACK * (len(part) - 1)).round().astype(int)] for part in tracks]
    return TagSite(segment, keyframe, position_m, np.unique(np.concatenate([beside, *viewers])), len(tracks))


def is_in_view(sensors: FloatArray, position_m: FloatArray, face: FloatArray, view: ViewStatistics) -> BoolArray:
    """Return which sensors (P,) have a tag in view that is at a position and faces along a vector."""
    away_m = position_m - sensors[:, :2]
    range_m = np.hypot(away_m[:, 0], away_m[:, 1])
    slant = -(away_m @ face) / np.maximum(range_m * np.hypot(*face), 1e-9)
    is_seen = (range_m >= view.near_m) & (range_m <= view.far_m) & (slant >= np.cos(MAX_INCIDENCE_RAD))
    facing = np.flatnonzero(is_seen)  # bearings take longest
    bearing_rad = se2.wrap_angle(np.arctan2(away_m[facing, 1], away_m[facing, 0]) - sensors[facing, 2])
    is_seen[facing] = np.abs(bearing_rad) <= view.half_angle_rad
    return np.asarray(is_seen)


def new_tag_gain(
    drives: DrivePaths, view: ViewStatistics, place: TagSite, seen: BoolArray | None = None
) -> InformationGain:
    """Return the information of a tag at a site on the poses that would observe it, and on the calibration.

    Args:
        drives: drives from `drive_paths`.
        view: view from `view_statistics`.
        place: place from `tag_sites`.
        seen: (k,) which of its viewers have it in view; all if None.
    """
    of_map = drives.graph.problem.columns
    poses = place.viewers if seen is None else place.viewers[seen]
    state = drives.state
    extended = State(state.poses, np.concatenate([state.tags, place.position_m[None]]), state.calibration)
    own, columns = _own_columns(of_map, poses)
    observations = _observations(drives, view, place, poses)
    return marginal_information((observations.linearise(extended, own),), 2, columns)


def _own_columns(of_map: Columns, poses: IntArray) -> tuple[Columns, IntArray]:
    """Return columns of one new tag, then of the map's poses and calibration, and the map's indices of the latter."""
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


def _observations(drives: DrivePaths, view: ViewStatistics, place: TagSite, poses: IntArray) -> ObservationFactors:
    """Return hypothetical observations, as many per track as usual, with the variances of others at that range."""
    observations, like = drives.graph.problem.observations, drives.example_observation[poses]
    sight = se2.apply(se2.inverse(drives.sensors[poses]), place.position_m)
    value = np.column_stack([np.hypot(*sight.T), np.arctan2(sight[:, 1], sight[:, 0])])
    at = np.searchsorted(view.range_m, value[:, 0])
    first = np.clip(at - _NEAREST_IN_RANGE // 2, 0, max(len(view.range_m) - _NEAREST_IN_RANGE, 0))
    variance = np.array([view.variance[i : i + _NEAREST_IN_RANGE].mean(axis=0) for i in first])
    n_each = view.observations_per_track * place.n_tracks / len(place.viewers)
    tag = np.full(len(poses), len(drives.state.tags))
    return ObservationFactors(
        pose=poses,
        tag=tag,
        value=value,
        polar=np.ones(len(tag), dtype=np.bool_),
        whitening=np.sqrt(max(n_each, 1.0) / variance)[:, :, None] * np.eye(2),
        mount=observations.mount[like],
        mount_parameters=observations.mount_parameters[like],
        scale_parameter=observations.scale_parameter[like],
        by_camera=np.zeros((len(tag), *observations.by_camera.shape[1:])),
        camera_parameters=observations.camera_parameters[like],
        turning_rad_s=np.zeros(len(tag)),
    )


def _viewing_tracks(drives: DrivePaths, poses: IntArray, least: float) -> list[IntArray]:
    """Split ascending poses into tracks where a segment ends or the robot drives on before it returns; keep a few.

    Tracks with fewer poses than a tag is observed from on average are dropped.
    """
    if not len(poses):
        return []
    along_m = np.concatenate(drives.along_m)[poses]
    segment = np.searchsorted(drives.graph.first_pose, poses, side="right")
    parts = np.split(poses, np.flatnonzero((np.diff(segment) != 0) | (np.diff(along_m) > TRACK_GAP_M)) + 1)
    parts = [part for part in parts if len(part) >= least]
    if len(parts) <= _MOST_TRACKS:
        return parts
    return [parts[i] for i in np.linspace(0, len(parts) - 1, _MOST_TRACKS).round().astype(int)]


def _farthest_points(places: list[TagSite], tags_m: FloatArray, most: int) -> list[TagSite]:
    """Choose sites by farthest-point sampling: each as far as possible from the tags and from those already chosen."""
    if len(places) <= most:
        return places
    where = np.array([place.position_m for place in places])
    away_m, _ = cKDTree(tags_m).query(where)
    chosen: list[int] = []
    for _ in range(most):
        chosen.append(int(np.argmax(away_m)))
        away_m = np.minimum(away_m, np.hypot(*(where - where[chosen[-1]]).T))
    return [places[i] for i in chosen]
