"""Consistency of wheels and tags in scale and turn, and what determines the scale of a map.

Observations determine the ratio of the tags' scale to the wheels' well, and hardly either of them. Their estimate of
the ratio is that of the solve without its priors; robot.yaml's estimate is that of the priors alone.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import TAG_SCALE
from groundsbot.offline.maps import ConsistencyCheck, ScaleBudget
from groundsbot.offline.sam import Graph, Solution

# The corrections that each check compares.
COMPARED_PARAMETERS: Final = {"scale": ("wheel_scale", TAG_SCALE), "turn": ("wheel_scale", "track_scale")}
# Relative information of weakened priors: a thousandth of the least that is used, far above rounding.
_WEAKENED: Final = 1e-5
# Observations whose sigma exceeds this multiple of robot.yaml's contain no information about the comparison.
_MAX_RELATIVE_SIGMA: Final = 10.0
_FIXED_SIGMA: Final = 1e-12  # sigma of fixed parameters: far below any that is given


def compare_wheels_and_tags(graph: Graph, solution: Solution, component: int) -> list[ConsistencyCheck]:
    """Return each robot's wheels compared with each batch of tags, where observations determine this."""
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


def comparison_warnings(checks: Sequence[ConsistencyCheck]) -> list[str]:
    """Return a warning for each contradiction between wheels and tags, with its size and usual cause."""
    return [_sentence(check) for check in checks if check.contradicts]


def scale_budget(graph: Graph, component: int) -> ScaleBudget:
    """Return the share of each prior and measurement in the information about the map's scale.

    Scaling the whole map changes no observation's residual; only priors and tape measurements resist it.
    """
    resists = dict.fromkeys(("wheels", "track", "tags", "mount", "distances", "starts"), 0.0)
    for parameter in graph.parameters:
        kind = {"wheel_scale": "wheels", "track_scale": "track", TAG_SCALE: "tags"}.get(parameter.name)
        if kind is not None:
            resists[kind] += 1.0 / max(parameter.sigma, _FIXED_SIGMA) ** 2
        elif parameter.name in ("mount_x_m", "mount_y_m"):
            x_m, y_m, _ = parameter.nominal
            stretched_m = x_m if parameter.name == "mount_x_m" else y_m
            resists["mount"] += (stretched_m / max(parameter.sigma, _FIXED_SIGMA)) ** 2
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
    """Return the excess of the first scale over the second by observations alone, its sigma, and that of the priors.

    With P the covariance of the priors and S that of the estimate m, observations alone have the information S^-1 -
    P^-1 and the estimate (S^-1 - P^-1)^-1 S^-1 m, since priors have zero mean. None where they do not determine it.
    """
    prior_sigma = solution.problem.prior.sigma[indices]
    columns = solution.problem.columns.calibration[indices]
    free = columns >= 0
    if not free.any():
        return None
    sign, corrections = np.array([1.0, -1.0])[free], solution.state.calibration[indices][free]
    # Derivative of the logarithm of the ratio: the ratio must not change where both are scaled alike.
    way = sign / (1.0 + corrections)
    allowed = float(np.sqrt((prior_sigma[free] ** 2).sum()))
    P = np.diag(prior_sigma[free] ** 2)
    S = solution.covariance(columns[free])
    # In units of the prior sigmas all parameters have similar size.
    unit = np.diag(1.0 / prior_sigma[free])
    weak = np.eye(len(way)) * _WEAKENED
    information = np.linalg.inv(unit @ S @ unit)
    own = np.linalg.inv(_positive(information - np.eye(len(way))) + weak)
    scaled_way = way @ np.sqrt(P)
    sigma = float(np.sqrt(scaled_way @ own @ scaled_way))
    if sigma > _MAX_RELATIVE_SIGMA * allowed:
        return None
    estimate = np.sqrt(P) @ own @ information @ unit @ corrections
    ratio = float(np.exp(sign @ np.log1p(corrections) + way @ (estimate - corrections)))
    return ratio - 1.0, ratio * sigma, allowed


def _positive(matrix: FloatArray) -> FloatArray:
    """Return the matrix with negative eigenvalues, due to rounding, set to zero."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    positive: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return positive


def _sentence(check: ConsistencyCheck) -> str:
    by = f"{100.0 * abs(check.value):.2f} % (sigma {100.0 * check.sigma:.2f} %)"
    allowed = f"{check.sigmas:.0f} sigma, where robot.yaml allows {100.0 * check.prior_sigma:.2f} %"
    if check.name == "turn":
        more = "more" if check.value > 0.0 else "less"
        return (
            f"wheels and tags contradict each other about a full turn: {check.robot_id} turns by {by} {more} than by "
            f"its wheels ({360.0 * abs(check.value):.1f} deg a turn; {allowed}); usually track_m is wrong, or the "
            "wheels slip when turning"
        )
    longer = "longer" if check.value > 0.0 else "shorter"
    larger, smaller = ("larger", "smaller") if check.value > 0.0 else ("smaller", "larger")
    return (
        f"wheels and tags contradict each other about the scale: a metre by the tags ({check.batch}) is {by} "
        f"{longer} by the wheels of {check.robot_id} ({allowed}). Usually the tags are {larger} than their given size "
        "(along the outer edge of the black border), or the wheels' radii are "
        f"{smaller} than in robot.yaml; measure a --distance to find out which"
    )
