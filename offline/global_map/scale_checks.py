"""Wheels held against tags: do both mean the same by a metre, and by a full turn? And what holds the metre at all.

Readings tell very well how a metre by the tags compares with one by the wheels, and hardly how long either is. What
they say of that comparison is the estimate without its priors; what robot.yaml allows is the priors alone.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import TAG_SCALE
from groundsbot.offline.maps import ConsistencyCheck, ScaleBudget
from groundsbot.offline.sam import Graph, Solution

# The corrections that each check compares.
COMPARED: Final = {"scale": ("wheel_scale", TAG_SCALE), "turn": ("wheel_scale", "track_scale")}
# Priors this much weaker, in variance, are as good as none.
_WEAKENED: Final = 1e-8
# Readings that tell the comparison no better than this many times what robot.yaml allows say nothing of it.
_TELLS_NOTHING: Final = 10.0
_HELD: Final = 1e-12  # the sigma of what is held: far below any that somebody gives


def checks_of(graph: Graph, solution: Solution, component: int) -> list[ConsistencyCheck]:
    """Each robot's wheels against each batch of tags that it read, where readings compare them."""
    found: dict[tuple[str, str, str | None], ConsistencyCheck] = {}
    for i, segment in enumerate(graph.segments):
        robot_id = segment.run.robot_id
        wheel_scale, _, track_scale = graph.wheel_parameters(i).tolist()
        pairs: list[tuple[str, str | None, list[int]]] = [
            ("scale", graph.parameters[batch].owner, [batch, wheel_scale]) for batch in graph.tag_scales(i).tolist()
        ]
        for name, batch, indices in [*pairs, ("turn", None, [wheel_scale, track_scale])]:
            compared = _compare(solution, np.array(indices))
            if compared is not None and (name, robot_id, batch) not in found:
                found[name, robot_id, batch] = ConsistencyCheck(name, component, robot_id, batch, *compared)
    return list(found.values())


def check_warnings(checks: Sequence[ConsistencyCheck]) -> list[str]:
    """Where wheels and tags contradict each other, by how much, and what that usually means."""
    return [_sentence(check) for check in checks if check.contradicts]


def scale_budget(graph: Graph, component: int) -> ScaleBudget:
    """How much of what holds the scale is due to what.

    Everything can be stretched together without a reading noticing. Along that way only priors and tapes resist.
    """
    resists = dict.fromkeys(("wheels", "track", "tags", "mount", "distances", "starts"), 0.0)
    for parameter in graph.parameters:
        kind = {"wheel_scale": "wheels", "track_scale": "track", TAG_SCALE: "tags"}.get(parameter.name)
        if kind is not None:
            resists[kind] += 1.0 / max(parameter.sigma, _HELD) ** 2
        elif parameter.name in ("mount_x_m", "mount_y_m"):
            x_m, y_m, _ = parameter.nominal
            stretched_m = x_m if parameter.name == "mount_x_m" else y_m
            resists["mount"] += (stretched_m / max(parameter.sigma, _HELD)) ** 2
    measured = graph.problem.measured
    resists["distances"] = float(((measured.distances.distance_m / measured.distances.sigma_m) ** 2).sum())
    x, y, theta = measured.starts.T_map_start.T
    cos, sin = np.cos(theta), np.sin(theta)
    stretched = np.stack([cos * x + sin * y, cos * y - sin * x, np.zeros_like(x)], axis=-1)
    resists["starts"] = float((np.einsum("mij,mj->mi", measured.starts.whitening, stretched) ** 2).sum())
    total = sum(resists.values())
    shares = {kind: value / total for kind, value in resists.items()} if total else resists
    return ScaleBudget(component, total**-0.5 if total else float("inf"), shares)


def _compare(solution: Solution, indices: IntArray) -> tuple[float, float, float] | None:
    """First correction less the second, by readings alone, its sigma, and that of the priors; None: they do not say.

    With P the covariance of the priors, S that of the estimate m: readings alone have the information S^-1 - P^-1 and
    the estimate (S^-1 - P^-1)^-1 S^-1 m, since priors are about zero.
    """
    prior_sigma = solution.problem.prior.sigma[indices]
    columns = solution.problem.columns.calibration[indices]
    free = columns >= 0
    way = np.array([1.0, -1.0])[free]
    allowed = float(np.sqrt((prior_sigma[free] ** 2).sum()))
    if not free.any():
        return None
    P = np.diag(prior_sigma[free] ** 2)
    S = solution.covariance(columns[free])
    # In sigmas of the priors all numbers are about one.
    unit = np.diag(1.0 / prior_sigma[free])
    weak = np.eye(len(way)) * _WEAKENED
    information = np.linalg.inv(unit @ S @ unit)
    own = np.linalg.inv(_positive(information - np.eye(len(way))) + weak)
    scaled_way = way @ np.sqrt(P)
    sigma = float(np.sqrt(scaled_way @ own @ scaled_way))
    if sigma > _TELLS_NOTHING * allowed:
        return None
    estimate = own @ information @ unit @ solution.state.calibration[indices][free]
    return float(scaled_way @ estimate), sigma, allowed


def _positive(matrix: FloatArray) -> FloatArray:
    """Without what rounding left below zero."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    positive: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return positive


def _sentence(check: ConsistencyCheck) -> str:
    by = f"{100.0 * abs(check.value):.2f} % (sigma {100.0 * check.sigma:.2f} %)"
    allowed = f"{check.sigmas:.0f} sigma, where robot.yaml allows {100.0 * check.prior_sigma:.2f} %"
    if check.name == "turn":
        more = "more" if check.value > 0.0 else "less"
        return (
            f"wheels and tags contradict each other about a full turn: {check.robot_id} turns by {by} {more} than its "
            f"wheels say ({360.0 * abs(check.value):.1f} deg a turn; {allowed}); usually track_m is wrong, or the "
            "wheels slip when turning"
        )
    longer = "longer" if check.value > 0.0 else "shorter"
    larger, smaller = ("larger", "smaller") if check.value > 0.0 else ("smaller", "larger")
    return (
        f"wheels and tags contradict each other about the metre: what the tags ({check.batch}) call one is {by} "
        f"{longer} by the wheels of {check.robot_id} ({allowed}); usually the tags are {larger} than their size says "
        "(it is measured along the outer edge of the black border), or the wheels' radii are "
        f"{smaller} than robot.yaml has them; a --distance settles which"
    )
