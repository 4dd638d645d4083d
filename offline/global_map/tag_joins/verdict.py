"""Decide whether shared tags determine the transform between two components: accurately, uniquely and consistently."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import degrees
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.alignment import MARGIN_NATS, variance_factor
from groundsbot.offline.corners import CornerSolution, Refined, alternative_states, solve_corners
from groundsbot.offline.global_map.solve_component import SolvedComponent
from groundsbot.offline.global_map.tag_joins.fit import (
    PlacedTags,
    TagFit,
    fit_transform_of_tags,
    placed_tags,
    radial_sigmas,
)
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, TagKey
from groundsbot.offline.sam import NotPositiveError

# Then sigma is at most 1.4 times its first-order value; where a tag is seen frontally it may be anything.
_MIN_LINEARITY: Final = 0.5
_SAME_RAD: Final = 1e-3  # optima closer than this are one
# Root mean square of a rotation's second-order part phi^2 / 2, over sigma^2: E phi^4 / 4 = 3/4 sigma^4.
_RMS_SECOND_ORDER: Final = 0.75**0.5


@dataclass(frozen=True)
class Verdict:
    """Transform of one component in another from the tags of both.

    Attributes:
        best: the most likely hypothesis.
        alternatives: others at least a hundredth as likely: a picture of a tag allows two poses.
        max_heading_sigma_rad: upper bound on the heading sigma.
    """

    best: TagFit
    alternatives: tuple[TagFit, ...]
    max_heading_sigma_rad: float

    def reason(self, a: str, b: str, tags: Sequence[TagKey]) -> str:
        """Return why component b, by the name of a run that saw the tags, is not joined to a; empty where it is."""
        ids = ", ".join(str(tag.tag_id) for tag in tags)
        head = f"{b} shares only tag{'s' * (len(tags) > 1)} {ids} with {a}"
        fit = self.best
        if not fit.is_consistent:
            off = f"{fit.cost_increase:.0f} squared sigmas, where chance explains {fit.degrees_of_freedom}"
            if len(tags) > 1:
                return f"{head}, each run one of them, and they contradict each other ({off}): were tags moved?"
            return f"{head}, which has another height or another tilt there ({off}): was it moved?"
        if fit.heading_sigma_rad > self.max_heading_sigma_rad:
            known, wanted = degrees(fit.heading_sigma_rad), degrees(self.max_heading_sigma_rad)
            return (
                f"{head}, seen too poorly to join them: it gives their relative heading to {known:.1f} deg, and "
                f"{wanted:.1f} deg are needed; view it from near and from the side, or drive past one more shared tag"
            )
        if min(fit.a.linearity, fit.b.linearity) < _MIN_LINEARITY:
            return (
                f"{head}, seen too frontally to join them: its orientation hardly shows; view it from the side, or "
                "drive past one more shared tag"
            )
        if self.alternatives:
            turns = ", ".join(f"{degrees(each.T_a_b[2]):.1f}" for each in (fit, *self.alternatives))
            return (
                f"{head}, whose corners allow {1 + len(self.alternatives)} orientations, so {b} may be turned by "
                f"{turns} deg: view it from the side, or drive past one more shared tag"
            )
        return ""


def verdict(maps: Sequence[LocalMap], a: SolvedComponent, b: SolvedComponent, tags: Sequence[TagKey]) -> Verdict | None:
    """Return the transform from tags in both components; None where one of them has no pose in space.

    Args:
        maps: local maps.
        a: a component, refined on corners.
        b: another.
        tags: tags that both components contain.
    """
    sides = [_pose_hypotheses(maps, each, tags) for each in (a, b)]
    if not all(sides):
        return None
    fits = sorted(
        (fit_transform_of_tags(one, other) for one, other in product(*sides)),
        key=lambda fit: fit.negative_log_likelihood,
    )
    best = fits[0]
    rivals: list[TagFit] = []
    for fit in fits[1:]:
        near = fit.negative_log_likelihood < best.negative_log_likelihood + MARGIN_NATS
        if near and not any(other.covers(fit) for other in (best, *rivals)):
            rivals.append(fit)
    return Verdict(best, tuple(rivals), min(_max_heading_sigma(each, tags[0]) for each in (a, b)))


def _pose_hypotheses(maps: Sequence[LocalMap], component: SolvedComponent, tags: Sequence[TagKey]) -> list[PlacedTags]:
    """Return possible poses of the tags in a component; of several tags only the map's, as wrong ones would not fit."""
    refined = component.refined
    if refined is None:
        return []
    which = _indices(component, tags)
    if not refined.corners.has_pose[which].all():
        return []
    factor = _variance_factor(maps, component, refined)
    anchor = int(component.graph.problem.anchor[which[0]])
    own = refined.solution
    solves = [own, *(_other_optima(own, int(which[0])) if len(which) == 1 else ())]
    ways = [placed_tags(each, which, anchor, factor, (each.cost - own.cost) / factor) for each in solves]
    return [each for each in ways if each.is_within_reach]


def _other_optima(own: CornerSolution, tag: int) -> list[CornerSolution]:
    """Return other optima of the whole component, started from the other poses that the tag's corners allow."""
    found: list[CornerSolution] = []
    for start in alternative_states(own.problem, own.state, tag):
        try:
            other = solve_corners(own.problem, start)
        except NotPositiveError:  # diverged to where corners contain no information
            continue
        turn = other.state.turns[tag]
        known = [each.state.turns[tag] for each in (own, *found)]
        if other.converged and all(Rotation.from_matrix(turn.T @ each).magnitude() > _SAME_RAD for each in known):
            found.append(other)
    return found


def _variance_factor(maps: Sequence[LocalMap], component: SolvedComponent, refined: Refined) -> float:
    """Return the factor of the noise variance, from the residuals of the runs and the corners, at least 1."""
    problem = refined.solution.problem
    n_priors = int((problem.prior.sigma > 0.0).sum())
    freedom = problem.n_residuals + n_priors - problem.columns.n
    left = 2.0 * refined.solution.cost / freedom if freedom > 0 else 1.0
    return max(left, *(variance_factor(maps[m]) for m in component.members.members))


def _max_heading_sigma(component: SolvedComponent, tag: TagKey) -> float:
    """Return the largest heading sigma about a tag with which a component may be rotated.

    A rotation by phi brings points at distance L nearer by L phi^2 / 2, which first-order covariances do not contain.
    Its root mean square, L sigma^2 sqrt(3/4), must be less than the sigma of the distance L itself.
    """
    refined = component.refined
    if refined is None:
        return 0.0
    anchor = int(component.graph.problem.anchor[_indices(component, [tag])[0]])
    far_m, sigma_m = radial_sigmas(refined.solution, anchor, component.graph.first_pose.tolist())
    return float(
        np.sqrt(
            np.hypot(sigma_m, UNMODELLED_SIGMA_M) / (_RMS_SECOND_ORDER * np.maximum(far_m, UNMODELLED_SIGMA_M))
        ).min()
    )


def _indices(component: SolvedComponent, tags: Sequence[TagKey]) -> IntArray:
    return np.array([component.graph.tags.index(tag) for tag in tags], dtype=np.int64)
