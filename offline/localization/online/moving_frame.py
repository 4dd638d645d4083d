"""A drive's turn in its map, taken out of what is linear: tags go along arcs, and the map knows them in straight lines.

A motion of everything as one changes no odometry and no observation. So what those say stays linear in a frame that
moves with the tags, as in floating frames of reference (Shabana, "Dynamics of Multibody Systems", 2013, chapter 5), and
what the map says is taken as it is. Along the turn that cost may be nowhere near a parabola: with tags 25 m away, and
wheels and map that pull at each other, steps in straight lines close in on its least by as little as three per cent
each.
"""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import inner, njit
from groundsbot.offline.localization.online.kernels import Border
from groundsbot.offline.sam import series, wrap

# A step whose slope is less than so many sigmas is where the cost is least.
_FLAT_SIGMAS: Final = 1e-4
_REMEMBERED: Final = 6  # steps, in the limited-memory quasi-Newton
_DESCENT: Final = 1e-4  # of what the slope promises, that a step must bring (Armijo)
_LEAST_SHARE: Final = 1e-3  # of a step: shorter ones are rounding
_NEAR_M: Final = 1.0


class BorderPrior(NamedTuple):
    """What the map tells of a border, see `OnlinePrior`, of which as many rows and columns count as it is long.

    Attributes:
        root: (N, N) lower triangular, and off (N,).
        places_m: (N, 2) about which it is linearised.
    """

    root: FloatArray
    off: FloatArray
    places_m: FloatArray


@njit
def rotate_step(known: BorderPrior, step: FloatArray, first: int) -> FloatArray:
    """(n,) how far a step (n,) of the border, tags from column `first` on, moves it, when its tags turn along arcs."""
    moved = step.copy()
    _turn(known, step, first, moved)
    return moved


@njit
def twist_of(known: BorderPrior, step: FloatArray, first: int) -> FloatArray:
    """(5,) what is common to the steps of all tags: a twist (turn and motion, as of a pose), and their middle."""
    return _twist(known, step, first)[0]


@inner
def _twist(known: BorderPrior, step: FloatArray, first: int) -> tuple[FloatArray, float]:
    """And the tags' lever (m^2) about their middle."""
    twist, lever, m = np.zeros(5), 0.0, (len(step) - first) // 2
    for t in range(m):
        for a in range(2):
            twist[1 + a] += step[first + 2 * t + a] / m
            twist[3 + a] += known.places_m[t, a] / m
    for t in range(m):
        x, y = known.places_m[t, 0] - twist[3], known.places_m[t, 1] - twist[4]
        lever += x * x + y * y
        twist[0] += x * step[first + 2 * t + 1] - y * step[first + 2 * t]
    twist[0] = twist[0] / lever if lever > 0.0 else 0.0
    return twist, lever


@inner
def _turn(known: BorderPrior, step: FloatArray, first: int, moved: FloatArray) -> tuple[FloatArray, float]:
    """Has all tags move by the exponential of their twist, and what is left of each step turn with them."""
    twist, lever = _twist(known, step, first)
    turn = twist[0]
    cos, sin = np.cos(turn), np.sin(turn)
    along, even, _ = series(turn)
    dx, dy = along * twist[1] - turn * even * twist[2], turn * even * twist[1] + along * twist[2]
    for t in range((len(step) - first) // 2):
        at = first + 2 * t
        x, y = known.places_m[t, 0] - twist[3], known.places_m[t, 1] - twist[4]
        u, v = x + step[at] - twist[1] + turn * y, y + step[at + 1] - twist[2] - turn * x
        moved[at], moved[at + 1] = dx + cos * u - sin * v - x, dy + sin * u + cos * v - y
    return twist, lever


@inner
def _turn_back(
    known: BorderPrior, step: FloatArray, first: int, told: tuple[FloatArray, float], slope: FloatArray
) -> None:
    """Makes a slope (n,) by where the border is one by the step."""
    twist, lever = told
    turn = twist[0]
    cos, sin, m = np.cos(turn), np.sin(turn), (len(step) - first) // 2
    along, even, odd = series(turn)
    by_turn, by_x, by_y = 0.0, 0.0, 0.0
    for t in range(m):
        at = first + 2 * t
        x, y = known.places_m[t, 0] - twist[3], known.places_m[t, 1] - twist[4]
        u, v = step[at] - twist[1] + turn * y, step[at + 1] - twist[2] - turn * x
        p, q = cos * slope[at] + sin * slope[at + 1], cos * slope[at + 1] - sin * slope[at]
        by_x += along * slope[at] + turn * even * slope[at + 1] - p
        by_y += along * slope[at + 1] - turn * even * slope[at] - q
        by_turn += q * u - p * v
        by_turn += slope[at] * ((odd - turn * even) * twist[1] - (along - even) * twist[2])
        by_turn += slope[at + 1] * ((along - even) * twist[1] + (odd - turn * even) * twist[2])
        slope[at], slope[at + 1] = p, q
    if lever == 0.0:
        by_turn, lever = 0.0, 1.0
    for t in range(m):
        at = first + 2 * t
        x, y = known.places_m[t, 0] - twist[3], known.places_m[t, 1] - twist[4]
        slope[at] += by_x / m - by_turn * y / lever
        slope[at + 1] += by_y / m + by_turn * x / lever


@inner
def _cost(border: Border, known: BorderPrior, z: FloatArray, slope: FloatArray) -> float:
    """Half the squared sigmas of S^-1 (d + z), less a constant; takes the slope by z."""
    n, first, root = len(z), border.first_tag[0], known.root
    step, straight, bent = np.empty(n), np.empty(n), np.empty(n)
    _substitute(border, z, step)
    moved = step.copy()
    told = _turn(known, step, first, moved)
    value = 0.0
    for i in range(n):
        straight[i], bent[i], slope[i] = 0.0, 0.0, 0.0
        for j in range(i + 1):
            straight[i] += root[i, j] * (step[j] - known.off[j])
            bent[i] += root[i, j] * (moved[j] - known.off[j])
        value += 0.5 * (z[i] * z[i] + bent[i] * bent[i] - straight[i] * straight[i])
        for j in range(i + 1):
            slope[j] += root[i, j] * bent[i]
    _turn_back(known, step, first, told, slope)
    for i in range(n):
        for j in range(i + 1):
            slope[j] -= root[i, j] * straight[i]
    _substitute_transpose(border, slope)
    slope += z
    return value


@inner
def _substitute(border: Border, z: FloatArray, step: FloatArray) -> None:
    """S^-1 (d + z), zero for what nothing tells of."""
    for i in range(len(z)):
        total = border.right[i] + z[i]
        for j in range(i):
            total -= border.root[i, j] * step[j]
        step[i] = total / border.root[i, i] if border.root[i, i] > 0.0 else 0.0


@inner
def _substitute_transpose(border: Border, slope: FloatArray) -> None:
    """Slope by z from that by S^-1 (d + z)."""
    for i in range(len(slope) - 1, -1, -1):
        slope[i] = slope[i] / border.root[i, i] if border.root[i, i] > 0.0 else 0.0
        for j in range(i):
            slope[j] -= border.root[i, j] * slope[i]


@njit
def minimise_on_arcs(border: Border, known: BorderPrior, begin: FloatArray, most: int) -> FloatArray:
    """(n,) z with the cost of S^-1 (d + z) least, tags turning along arcs.

    Limited-memory quasi-Newton (Nocedal and Wright, "Numerical Optimization", 2006, 7.2) in the coordinates in which
    the cost without the arcs is a unit parabola.

    Args:
        border: S and d, of what all say in straight lines.
        known: what the map says, which that holds too.
        begin: (n,) from where; what is found is no worse.
        most: costs to be worked out; when they are spent, the best so far.
    """
    n = len(begin)
    z, slope, ahead, slope_ahead = begin.copy(), np.empty(n), np.empty(n), np.empty(n)
    steps, yields = np.empty((_REMEMBERED, n)), np.empty((_REMEMBERED, n))
    value, kept, share = _cost(border, known, z, slope), 0, 1.0
    for _ in range(most - 1):
        if (slope * slope).sum() <= _FLAT_SIGMAS**2 or share < _LEAST_SHARE:
            break
        way = _downhill(slope, steps, yields, kept)
        ahead[:] = z + share * way
        value_ahead = _cost(border, known, ahead, slope_ahead)
        if value_ahead > value + _DESCENT * share * (way * slope).sum():
            share *= 0.5
            continue
        s, y = ahead - z, slope_ahead - slope
        if (s * y).sum() > 0.0:
            steps[kept % _REMEMBERED], yields[kept % _REMEMBERED] = s, y
            kept += 1
        z[:], slope[:], value, share = ahead, slope_ahead, value_ahead, 1.0
    return z


@inner
def _downhill(slope: FloatArray, steps: FloatArray, yields: FloatArray, kept: int) -> FloatArray:
    """(n,) a step, from the last steps and what the slope made of each: the two loops of the limited-memory method."""
    way, alpha, first = -slope, np.empty(_REMEMBERED), max(kept - _REMEMBERED, 0)
    for k in range(kept - 1, first - 1, -1):
        at = k % _REMEMBERED
        alpha[at] = (steps[at] * way).sum() / (steps[at] * yields[at]).sum()
        way -= alpha[at] * yields[at]
    for k in range(first, kept):
        at = k % _REMEMBERED
        way += (alpha[at] - (yields[at] * way).sum() / (steps[at] * yields[at]).sum()) * steps[at]
    return way


@njit
def pose_among(before_m: FloatArray, after_m: FloatArray, pose: FloatArray) -> FloatArray:
    """(3,) where a pose (3,) was before places (T, 2) moved, if it moved along with those near it.

    The rigid motion is that of least squares in closed form (Umeyama, "Least-squares estimation of transformation
    parameters between two point patterns", 1991), weighed by the inverse square of the distance.
    """
    weights, mean, total = np.empty(len(after_m)), np.zeros(4), 0.0
    for t in range(len(after_m)):
        x, y = after_m[t, 0] - pose[0], after_m[t, 1] - pose[1]
        weights[t] = 1.0 / (_NEAR_M**2 + x * x + y * y)
        total += weights[t]
        for a in range(2):
            mean[a] += weights[t] * before_m[t, a]
            mean[2 + a] += weights[t] * after_m[t, a]
    if total == 0.0:
        return pose.copy()
    mean /= total
    even, odd = 0.0, 0.0
    for t in range(len(after_m)):
        x, y = before_m[t, 0] - mean[0], before_m[t, 1] - mean[1]
        u, v = after_m[t, 0] - mean[2], after_m[t, 1] - mean[3]
        even += weights[t] * (x * u + y * v)
        odd += weights[t] * (x * v - y * u)
    turn = np.arctan2(odd, even) if even * even + odd * odd > 0.0 else 0.0
    cos, sin = np.cos(turn), np.sin(turn)
    x, y = pose[0] - mean[2], pose[1] - mean[3]
    return np.array([mean[0] + cos * x + sin * y, mean[1] + cos * y - sin * x, wrap(pose[2] - turn)])
