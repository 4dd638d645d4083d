"""Compiled loops over passes of tags; see `pass_model`."""

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import FloatBlocks, FloatMatrix, FloatVector, IntVector, inner, njit


@njit
def set_poses(
    time_s: FloatVector,
    motion: FloatMatrix,
    track_m: float,
    parameters: FloatVector,
    stations_s: FloatVector,
    first_station: IntVector,
    pose: FloatMatrix,
    by_motion: FloatBlocks,
) -> None:
    """Set the poses (S, 3) of stations and their derivatives (S, 3, 3) by time offset, wheel ratio and turn factor.

    Args:
        time_s: (N,) of the wheel readings.
        motion: (N, 6) as in `WheelAxis`.
        track_m: distance between the wheels.
        parameters: (8,) in order of `pass_model.PARAMETERS`.
        stations_s: (S,) times of the stations.
        first_station: (G,) the first of each pass, in whose frame the poses are.
        pose: result.
        by_motion: result; the last axis is that of the parameters.
    """
    offset_s, ratio, turn = parameters[0], parameters[1], parameters[2]
    turns, left, right = (1.0 + turn) / track_m, 1.0 - 0.5 * ratio, 1.0 + 0.5 * ratio
    at, since, before, begin = np.empty(6), np.empty((4, 3)), np.empty((4, 3)), np.empty(4)
    x, y = np.empty(4), np.empty(4)
    for group in range(len(first_station)):
        end = first_station[group + 1] if group + 1 < len(first_station) else len(stations_s)
        index = np.searchsorted(time_s, stations_s[first_station[group]] - offset_s)
        for station in range(first_station[group], end):
            index = _interpolate(time_s, motion, stations_s[station] - offset_s, index, at)
            _sum_motion(at, turns, left, right, turn, since)
            if station == first_station[group]:
                begin[:] = since[:, 1]
                before[:] = since
                pose[station] = 0.0
                by_motion[station] = 0.0
                continue
            turned = since[0, 1] - before[0, 1]
            half = 0.5 * turned
            sinc = np.sin(half) / half if half != 0.0 else 1.0
            heading = since[0, 1] - begin[0] - half
            cos, sin = np.cos(heading), np.sin(heading)
            ahead, aside = since[0, 0] - before[0, 0], since[0, 2] - before[0, 2]
            for k in range(4):
                turn_k = since[k, 1] - before[k, 1]
                along, across = (since[k, 0] - before[k, 0]) * sinc, (since[k, 2] - before[k, 2]) * sinc
                if k > 0:  # sinc(turned / 2) to its first order
                    along -= ahead * turned / 12.0 * turn_k
                    across -= aside * turned / 12.0 * turn_k
                x[k], y[k] = along * cos - across * sin, along * sin + across * cos
                if k > 0:
                    middle = since[k, 1] - begin[k] - 0.5 * turn_k
                    x[k], y[k] = x[k] - y[0] * middle, y[k] + x[0] * middle
                    by_motion[station, 0, k - 1] = by_motion[station - 1, 0, k - 1] + x[k]
                    by_motion[station, 1, k - 1] = by_motion[station - 1, 1, k - 1] + y[k]
                    by_motion[station, 2, k - 1] = since[k, 1] - begin[k]
            pose[station, 0], pose[station, 1] = pose[station - 1, 0] + x[0], pose[station - 1, 1] + y[0]
            pose[station, 2] = since[0, 1] - begin[0]
            before[:] = since


@inner
def _interpolate(time_s: FloatArray, motion: FloatArray, at_s: float, index: int, out: FloatArray) -> int:
    """Set out (6,) to the motion at a time, held beyond the ends; return the reading before, from a near one on."""
    index = min(max(index, 0), len(time_s) - 2)
    while index > 0 and time_s[index] > at_s:
        index -= 1
    while index < len(time_s) - 2 and time_s[index + 1] <= at_s:
        index += 1
    share = min(max((at_s - time_s[index]) / (time_s[index + 1] - time_s[index]), 0.0), 1.0)
    for i in range(6):
        out[i] = (1.0 - share) * motion[index, i] + share * motion[index + 1, i]
    return index


@inner
def _sum_motion(motion: FloatArray, turns: float, left: float, right: float, turn: float, out: FloatArray) -> None:
    """Set out (4, 3) to way, heading and way to the left, and derivatives by time offset, wheel ratio, turn factor."""
    left_m, right_m = motion[0], motion[1]
    out[0, 0], out[0, 1], out[0, 2] = 0.5 * (left * left_m + right * right_m), 0.0, motion[2]
    out[0, 1] = turns * (right * right_m - left * left_m)
    out[1, 0], out[1, 2] = -0.5 * (left * motion[3] + right * motion[4]), -motion[5]
    out[1, 1] = -turns * (right * motion[4] - left * motion[3])
    out[2, 0], out[2, 1], out[2, 2] = 0.25 * (right_m - left_m), 0.5 * turns * (right_m + left_m), 0.0
    out[3, 0], out[3, 1], out[3, 2] = 0.0, out[0, 1] / (1.0 + turn), 0.0


@njit
def set_derivatives(
    pose: FloatMatrix,
    by_motion: FloatBlocks,
    at: IntVector,
    group: IntVector,
    value: FloatMatrix,
    sensor: FloatMatrix,
    parameters: FloatVector,
    tags_m: FloatMatrix,
    nearest_m: float,
    residual: FloatMatrix,
    by_tag: FloatBlocks,
    by_parameters: FloatBlocks,
) -> None:
    """Set residuals and derivatives of M observations, as in `pass_model.LinearisedTracks`.

    Args:
        pose: (S, 3) of the stations.
        by_motion: (S, 3, 3) their derivatives.
        at: (M,) the station of each observation.
        group: (M,) its pass.
        value: (M, 2) range and bearing.
        sensor: (M, 3) mount by robot.yaml.
        parameters: (8,) in order of `pass_model.PARAMETERS`.
        tags_m: (G, 2) positions of the tags.
        nearest_m: lower bound on ranges.
        residual: result.
        by_tag: result.
        by_parameters: result.
    """
    scale = 1.0 + parameters[7]
    for m in range(len(at)):
        station = at[m]
        cos, sin = np.cos(pose[station, 2]), np.sin(pose[station, 2])
        dx, dy = tags_m[group[m], 0] - pose[station, 0], tags_m[group[m], 1] - pose[station, 1]
        base_x, base_y = cos * dx + sin * dy, cos * dy - sin * dx
        x, y = base_x - sensor[m, 0] - parameters[3], base_y - sensor[m, 1] - parameters[4]
        range_m = max(np.hypot(x, y), nearest_m)
        residual[m, 0] = range_m / scale + parameters[6] - value[m, 0]
        bearing_rad = np.arctan2(y, x) - sensor[m, 2] - parameters[5] - value[m, 1]
        residual[m, 1] = bearing_rad - 2.0 * np.pi * np.rint(bearing_rad / (2.0 * np.pi))
        for i in range(2):
            if i == 0:
                first, second = x / (scale * range_m), y / (scale * range_m)
            else:
                first, second = -y / range_m**2, x / range_m**2
            tag_x, tag_y = cos * first - sin * second, sin * first + cos * second
            by_theta = first * base_y - second * base_x
            by_tag[m, i, 0], by_tag[m, i, 1] = tag_x, tag_y
            for k in range(3):
                own = by_motion[station]
                by_parameters[m, i, k] = by_theta * own[2, k] - tag_x * own[0, k] - tag_y * own[1, k]
            by_parameters[m, i, 3], by_parameters[m, i, 4] = -first, -second
            by_parameters[m, i, 5], by_parameters[m, i, 6], by_parameters[m, i, 7] = 0.0, 0.0, 0.0
        by_parameters[m, 1, 5], by_parameters[m, 0, 6] = -1.0, 1.0
        by_parameters[m, 0, 7] = -range_m / scale**2


@njit
def add_squares(
    group: IntVector,
    residual: FloatMatrix,
    by_tag: FloatBlocks,
    by_parameters: FloatBlocks,
    weights: FloatMatrix,
    out: FloatBlocks,
) -> None:
    """Add J^T W J of each pass to out (G, 11, 11), with the columns of J by the tag, the parameters and the residual.

    Args:
        group: (M,) pass of each observation.
        residual: (M, 2) as in `pass_model.LinearisedTracks`, and so are the next two.
        by_tag: (M, 2, 2).
        by_parameters: (M, 2, 8).
        weights: (M, 2) of squared residuals.
        out: result.
    """
    row = np.empty(11)
    for m in range(len(group)):
        own = out[group[m]]
        for i in range(2):
            row[0], row[1], row[10] = by_tag[m, i, 0], by_tag[m, i, 1], residual[m, i]
            for k in range(8):
                row[2 + k] = by_parameters[m, i, k]
            for a in range(11):
                weighted = weights[m, i] * row[a]
                for b in range(11):
                    own[a, b] += weighted * row[b]
