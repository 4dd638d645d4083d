"""Whether shared tags tell how two components lie to each other: well enough, in one way only, and as one."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import degrees
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.alignment import MARGIN_NATS, variance_factor
from groundsbot.offline.corners import CornerSolution, NotPositiveError, Refined, alternative_states, solve_corners
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

# Then sigma is no more than 1.4 times what first order says of it; where a tag is seen squarely it may be anything.
_LEAST_STRAIGHTNESS: Final = 0.5
_SAME_RAD: Final = 1e-3  # solves that end nearer than this are one
# Mean square of a turn's second-order part phi^2 / 2, over sigma^4: E phi^4 / 4 = 3/4.
_BENT: Final = 0.75**0.5


@dataclass(frozen=True)
class Verdict:
    """How one component lies in another by the tags of both.

    Attributes:
        best: the likeliest way.
        rivals: other ways that are not a hundred times less likely: a picture of a tag allows two poses.
        most_heading_sigma_rad: how well its turn must be known.
    """

    best: TagFit
    rivals: tuple[TagFit, ...]
    most_heading_sigma_rad: float

    def reason(self, a: str, b: str, tags: Sequence[TagKey]) -> str:
        """Why component b, by the name of a run that saw the tags, is not joined to a; empty where it is."""
        ids = ", ".join(str(tag.tag_id) for tag in tags)
        head = f"{b} shares only tag{'s' * (len(tags) > 1)} {ids} with {a}"
        fit = self.best
        if not fit.closes:
            off = f"{fit.cost_increase:.0f} squared sigmas, where chance explains {fit.freedom}"
            if len(tags) > 1:
                return f"{head}, each run one of them, and they contradict each other ({off}): were tags moved?"
            return f"{head}, which hangs at another height there or leans another way ({off}): was it moved?"
        if fit.heading_sigma_rad > self.most_heading_sigma_rad:
            known, wanted = degrees(fit.heading_sigma_rad), degrees(self.most_heading_sigma_rad)
            return (
                f"{head}, seen too poorly to join them: it tells how they are turned to {known:.1f} deg, and "
                f"{wanted:.1f} deg would do; look at it from near and from the side, or drive past one more shared tag"
            )
        if min(fit.a.straightness, fit.b.straightness) < _LEAST_STRAIGHTNESS:
            return (
                f"{head}, seen too squarely to join them: how it is turned hardly shows; look at it from the side, or "
                "drive past one more shared tag"
            )
        if self.rivals:
            turns = ", ".join(f"{degrees(each.T_a_b[2]):.1f}" for each in (fit, *self.rivals))
            return (
                f"{head}, which by its corners may hang in {1 + len(self.rivals)} ways, and {b} be turned by {turns} "
                "deg: look at it from the side, or drive past one more shared tag"
            )
        return ""


def verdict(maps: Sequence[LocalMap], a: SolvedComponent, b: SolvedComponent, tags: Sequence[TagKey]) -> Verdict | None:
    """What tags that hang in both tell; None where one of them is not known in space.

    Args:
        maps: local maps.
        a: a component, refined on corners.
        b: another.
        tags: of both.
    """
    sides = [_ways(maps, each, tags) for each in (a, b)]
    if not all(sides):
        return None
    fits = sorted((fit_transform_of_tags(one, other) for one, other in product(*sides)), key=lambda fit: fit.nats)
    best = fits[0]
    rivals: list[TagFit] = []
    for fit in fits[1:]:
        near = fit.nats < best.nats + MARGIN_NATS
        if near and not any(other.covers(fit) for other in (best, *rivals)):
            rivals.append(fit)
    return Verdict(best, tuple(rivals), min(_most_heading_sigma(each, tags[0]) for each in (a, b)))


def _ways(maps: Sequence[LocalMap], component: SolvedComponent, tags: Sequence[TagKey]) -> list[PlacedTags]:
    """How the tags may hang in a component; of several only as they hang in its map: a wrong one would not fit."""
    refined = component.refined
    if refined is None:
        return []
    which = _indices(component, tags)
    if not refined.corners.has_pose[which].all():
        return []
    factor = _variance_factor(maps, component, refined)
    anchor = int(component.graph.problem.anchor[which[0]])
    own = refined.solution
    solves = [own, *(_other_solves(own, int(which[0])) if len(which) == 1 else ())]
    ways = [placed_tags(each, which, anchor, factor, (each.cost - own.cost) / factor) for each in solves]
    return [each for each in ways if each.is_known]


def _other_solves(own: CornerSolution, tag: int) -> list[CornerSolution]:
    """Other optima of the whole component, found from the other ways in which its looks allow a tag to hang."""
    found: list[CornerSolution] = []
    for start in alternative_states(own.problem, own.state, tag):
        try:
            other = solve_corners(own.problem, start)
        except NotPositiveError:  # run off to where no look says anything
            continue
        turn = other.state.turns[tag]
        known = [each.state.turns[tag] for each in (own, *found)]
        if other.converged and all(Rotation.from_matrix(turn.T @ each).magnitude() > _SAME_RAD for each in known):
            found.append(other)
    return found


def _variance_factor(maps: Sequence[LocalMap], component: SolvedComponent, refined: Refined) -> float:
    """By which noise is larger than was told, by what the runs and the corners leave over; 1 at least."""
    problem = refined.solution.problem
    n_priors = int((problem.prior.sigma > 0.0).sum())
    freedom = problem.n_residuals + n_priors - problem.columns.n
    left = 2.0 * refined.solution.cost / freedom if freedom > 0 else 1.0
    return max(left, *(variance_factor(maps[m]) for m in component.members.members))


def _most_heading_sigma(component: SolvedComponent, tag: TagKey) -> float:
    """How well the turn about a tag must be known for a component to be turned by it.

    A turn by phi brings what is L away nearer by L phi^2 / 2, of which covariances, being of first order, know nothing.
    In the root mean square, L sigma^2 sqrt(3/4), that must be less than what is not known of the distance L anyway.
    """
    refined = component.refined
    if refined is None:
        return 0.0
    anchor = int(component.graph.problem.anchor[_indices(component, [tag])[0]])
    far_m, sigma_m = radial_sigmas(refined.solution, anchor, component.graph.first_pose.tolist())
    return float(np.sqrt(np.hypot(sigma_m, UNMODELLED_SIGMA_M) / (_BENT * np.maximum(far_m, UNMODELLED_SIGMA_M))).min())


def _indices(component: SolvedComponent, tags: Sequence[TagKey]) -> IntArray:
    return np.array([component.graph.tags.index(tag) for tag in tags], dtype=np.int64)
