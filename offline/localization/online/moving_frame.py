"""Treats the common rotation of a drive in its map exactly: tags move on arcs, while the map's prior is linear.

A rigid motion of poses and tags changes no odometry and no observation. Their factors therefore remain linear in a
frame that moves with the tags, as in floating frames of reference (Shabana, "Dynamics of Multibody Systems", 2013,
chapter 5), and the map's prior is evaluated at the moved tags. Along the rotation the cost may be far from a parabola:
with tags 25 m away, and wheels that contradict the map, a linear step may reduce the distance to the minimum by only
three percent.
"""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import inner, njit
from groundsbot.offline.localization.online.kernels import Border
from groundsbot.offline.sam import series, wrap

# Converged where the norm of the gradient, in sigmas, is below this.
_GRADIENT_TOLERANCE: Final = 1e-4
_MEMORY: Final = 6  # steps stored by the limited-memory quasi-Newton method
_DESCENT: Final = 1e-4  # share of the predicted decrease that a step must reach (Armijo)
_LEAST_SHARE: Final = 1e-3  # of a step; shorter ones are rounding
_NEAR_M: Final = 1.0


class BorderPrior(NamedTuple):
    """The arrays of an `OnlinePrior` with spare capacity; as many rows and columns as the border has are in use.

    Attributes:
        root: (N, N) lower triangular square-root information.
        off: (N,) mean, relative to the linearisation points.
        places_m: (N, 2) linearisation points of the tags.
    """

    root: FloatArray
    off: FloatArray
    places_m: FloatArray


@njit
def rotate_step(known: BorderPrior, step: FloatArray, first: int) -> FloatArray:
    """Return (n,) the offset of the border by a step (n,) whose tags, from column `first` on, move on arcs."""
    moved = step.copy()
    _move_tags(known, step, first, moved)
    return moved


@njit
def twist_of(known: BorderPrior, step: FloatArray, first: int) -> FloatArray:
    """Return (5,) the common twist of the tags' steps (rotation, translation) and the tags' centre."""
    return _twist(known, step, first)[0]


@inner
def _twist(known: BorderPrior, step: FloatArray, first: int) -> tuple[FloatArray, float]:
    """Return the twist as in `twist_of`, and the tags' sum of squared distances from their centre, m^2."""
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
def _move_tags(known: BorderPrior, step: FloatArray, first: int, moved: FloatArray) -> tuple[FloatArray, float]:
    """Move all tags by the exponential of their twist, and rotate the remainder of each step; fills `moved`.

    Returns the twist and lever of `_twist`.
    """
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
def _pull_back(
    known: BorderPrior, step: FloatArray, first: int, twist_lever: tuple[FloatArray, float], gradient: FloatArray
) -> None:
    """Transform a gradient (n,) by the offset of the border into one by the step, in place: adjoint of `_move_tags`."""
    twist, lever = twist_lever
    turn = twist[0]
    cos, sin, m = np.cos(turn), np.sin(turn), (len(step) - first) // 2
    along, even, odd = series(turn)
    by_turn, by_x, by_y = 0.0, 0.0, 0.0
    for t in range(m):
        at = first + 2 * t
        x, y = known.places_m[t, 0] - twist[3], known.places_m[t, 1] - twist[4]
        u, v = step[at] - twist[1] + turn * y, step[at + 1] - twist[2] - turn * x
        p, q = cos * gradient[at] + sin * gradient[at + 1], cos * gradient[at + 1] - sin * gradient[at]
        by_x += along * gradient[at] + turn * even * gradient[at + 1] - p
        by_y += along * gradient[at + 1] - turn * even * gradient[at] - q
        by_turn += q * u - p * v
        by_turn += gradient[at] * ((odd - turn * even) * twist[1] - (along - even) * twist[2])
        by_turn += gradient[at + 1] * ((along - even) * twist[1] + (odd - turn * even) * twist[2])
        gradient[at], gradient[at + 1] = p, q
    if lever == 0.0:
        by_turn, lever = 0.0, 1.0
    for t in range(m):
        at = first + 2 * t
        x, y = known.places_m[t, 0] - twist[3], known.places_m[t, 1] - twist[4]
        gradient[at] += by_x / m - by_turn * y / lever
        gradient[at + 1] += by_y / m + by_turn * x / lever


@inner
def _cost(border: Border, known: BorderPrior, z: FloatArray, gradient: FloatArray) -> float:
    """Return the cost of the step S^-1 (d + z), less a constant, and fill its gradient by z.

    The cost is (|z|^2 - |R (x - o)|^2 + |R (moved x - o)|^2) / 2 with the prior's root R and mean o.
    """
    n, first, root = len(z), border.first_tag[0], known.root
    step, linear, on_arcs = np.empty(n), np.empty(n), np.empty(n)
    _substitute(border, z, step)
    moved = step.copy()
    twist_lever = _move_tags(known, step, first, moved)
    value = 0.0
    for i in range(n):
        linear[i], on_arcs[i], gradient[i] = 0.0, 0.0, 0.0
        for j in range(i + 1):
            linear[i] += root[i, j] * (step[j] - known.off[j])
            on_arcs[i] += root[i, j] * (moved[j] - known.off[j])
        value += 0.5 * (z[i] * z[i] + on_arcs[i] * on_arcs[i] - linear[i] * linear[i])
        for j in range(i + 1):
            gradient[j] += root[i, j] * on_arcs[i]
    _pull_back(known, step, first, twist_lever, gradient)
    for i in range(n):
        for j in range(i + 1):
            gradient[j] -= root[i, j] * linear[i]
    _substitute_transpose(border, gradient)
    gradient += z
    return value


@inner
def _substitute(border: Border, z: FloatArray, step: FloatArray) -> None:
    """Fill `step` with S^-1 (d + z), zero for variables without information."""
    for i in range(len(z)):
        total = border.right[i] + z[i]
        for j in range(i):
            total -= border.root[i, j] * step[j]
        step[i] = total / border.root[i, i] if border.root[i, i] > 0.0 else 0.0


@inner
def _substitute_transpose(border: Border, gradient: FloatArray) -> None:
    """Transform the gradient by S^-1 (d + z) into that by z, in place."""
    for i in range(len(gradient) - 1, -1, -1):
        gradient[i] = gradient[i] / border.root[i, i] if border.root[i, i] > 0.0 else 0.0
        for j in range(i):
            gradient[j] -= border.root[i, j] * gradient[i]


@njit
def minimise_on_arcs(border: Border, known: BorderPrior, begin: FloatArray, max_evaluations: int) -> FloatArray:
    """Return (n,) the z that minimises the cost of the step S^-1 (d + z) with tags on arcs.

    This is the limited-memory quasi-Newton method (Nocedal and Wright, "Numerical Optimization", 2006, 7.2) in
    coordinates in which the linear cost has the identity as its Hessian.

    Args:
        border: S and d of all linearised factors, including the prior.
        known: the prior.
        begin: (n,) start; the result has no larger cost.
        max_evaluations: limit on evaluations of the cost.
    """
    n = len(begin)
    z, gradient, trial, trial_gradient = begin.copy(), np.empty(n), np.empty(n), np.empty(n)
    steps, changes = np.empty((_MEMORY, n)), np.empty((_MEMORY, n))
    value, n_steps, share = _cost(border, known, z, gradient), 0, 1.0
    for _ in range(max_evaluations - 1):
        if (gradient * gradient).sum() <= _GRADIENT_TOLERANCE**2 or share < _LEAST_SHARE:
            break
        direction = _descent_direction(gradient, steps, changes, n_steps)
        trial[:] = z + share * direction
        trial_value = _cost(border, known, trial, trial_gradient)
        if trial_value > value + _DESCENT * share * (direction * gradient).sum():
            share *= 0.5
            continue
        s, y = trial - z, trial_gradient - gradient
        if (s * y).sum() > 0.0:
            steps[n_steps % _MEMORY], changes[n_steps % _MEMORY] = s, y
            n_steps += 1
        z[:], gradient[:], value, share = trial, trial_gradient, trial_value, 1.0
    return z


@inner
def _descent_direction(gradient: FloatArray, steps: FloatArray, changes: FloatArray, n_steps: int) -> FloatArray:
    """Return (n,) the direction by the two-loop recursion, from the last steps and changes of the gradient."""
    direction, alpha, first = -gradient, np.empty(_MEMORY), max(n_steps - _MEMORY, 0)
    for k in range(n_steps - 1, first - 1, -1):
        at = k % _MEMORY
        alpha[at] = (steps[at] * direction).sum() / (steps[at] * changes[at]).sum()
        direction -= alpha[at] * changes[at]
    for k in range(first, n_steps):
        at = k % _MEMORY
        direction += (alpha[at] - (changes[at] * direction).sum() / (steps[at] * changes[at]).sum()) * steps[at]
    return direction


@njit
def pose_among(before_m: FloatArray, after_m: FloatArray, pose: FloatArray, point: FloatArray) -> FloatArray:
    """Return (3,) a pose moved back from `after_m` (T, 2) to `before_m` (T, 2), along with the tags near it.

    The rigid motion is the least-squares solution in closed form (Umeyama, "Least-squares estimation of transformation
    parameters between two point patterns", 1991), with weights of about the inverse squared distance from the pose, so
    that residuals are angles. The heading is one more residual: a single tag, or several close together, do not
    determine the rotation, which their rounding or noise would decide.

    Args:
        before_m: tags that the result is to be among.
        after_m: the same tags around `pose`.
        pose: (3,) to be moved.
        point: (3,) the same pose among `before_m` by the motion to it; the result where there are no tags.
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
        return point.copy()
    mean /= total
    even, odd = np.cos(pose[2] - point[2]), np.sin(pose[2] - point[2])
    for t in range(len(after_m)):
        x, y = before_m[t, 0] - mean[0], before_m[t, 1] - mean[1]
        u, v = after_m[t, 0] - mean[2], after_m[t, 1] - mean[3]
        even += weights[t] * (x * u + y * v)
        odd += weights[t] * (x * v - y * u)
    turn = np.arctan2(odd, even)
    cos, sin = np.cos(turn), np.sin(turn)
    x, y = pose[0] - mean[2], pose[1] - mean[3]
    return np.array([mean[0] + cos * x + sin * y, mean[1] + cos * y - sin * x, wrap(pose[2] - turn)])
