"""Where a robot that has just been put down is in a finished map, looked for a little at each observation.

As in `alignment.ransac`, pairs of tags are hypotheses; tags that a hypothesis foretells join it. Here the drive so far
is short, and the map is taken in its own axes, so a hypothesis is one rigid fit. The verdict is given when all pairs
have been looked at.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment import (
    CHANCE_NATS,
    FitState,
    Hypothesis,
    HypothesisTest,
    LinearisedFit,
    distances,
    fit_members,
    gate_ratio,
    is_same_distance,
    rotate_quarter,
    transform_from_two_tags,
)
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, TagKey

_STEPS: Final = 4
# Two tags are held against each other by their distance alone, which a tag that was moved aside keeps: nothing
# contradicts a place that is off by as much. Any one of three is told by the others.
LEAST_FITTING: Final = 3
_NONE: Final = np.zeros(0)


@dataclass(frozen=True)
class SeenTags:
    """Tags as the robot has them in the frame of its start.

    Attributes:
        tags: ids; places_m: (n, 2); covariance: (2 n, 2 n).
    """

    tags: tuple[TagKey, ...]
    places_m: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Start:
    """Where the start lies.

    Attributes:
        T_map_start: (3,) nearly.
        tags: index of each tag that fits among those seen, and the map's tag that it is.
    """

    T_map_start: FloatArray
    tags: tuple[tuple[int, TagKey], ...]


class StartSearch:
    """Goes through the pairs of tags seen, one a call, and begins anew when there is another tag, or no verdict."""

    def __init__(self, known: MapPrior) -> None:
        self._known = known
        self._pairs: list[tuple[int, TagKey]] = []
        self._left: list[tuple[int, int]] | None = None  # pairs to look at; None when it begins anew
        self._found: list[Hypothesis] = []
        self.reason = "no tag of the map was seen yet"

    def search(self, seen: SeenTags) -> Start | None:
        """Looks a little further; the start when that is sure, else None and `reason`."""
        pairs = [(i, tag) for i, own in enumerate(seen.tags) for tag in self._known.instances.get(own, ())]
        if len({i for i, _ in pairs}) < 2:
            self.reason = f"{'one tag' if pairs else 'no tag'} of the map was seen; two are needed"
            return None
        if pairs == self._pairs and self._left is not None and not self._left:
            self._left = None
            return self._verdict(_RigidFit(self._known, seen, pairs))
        fit = _RigidFit(self._known, seen, pairs)
        if pairs != self._pairs or self._left is None:  # all of it anew: by now the places are better known
            self._pairs, self._found, self._left = pairs, [], fit.same_distances()
        else:
            found = fit.grow(*self._left.pop(0))
            if found is not None:
                self._found.append(found)
                known = np.flatnonzero(found.members).tolist()
                self._left = [pair for pair in self._left if not set(pair) <= set(known)]
        self.reason = "looking for the start"
        return None

    def _verdict(self, fit: "_RigidFit") -> Start | None:
        n = fit.n
        if not self._found:
            self.reason = f"no two of the {n} tags that may be the map's lie as they do in the map"
            return None
        rivalry = HypothesisTest(fit.places_a, fit.places_b)
        found = sorted(((rivalry.log_bayes_factor(each), each) for each in self._found), key=lambda f: -f[0])
        evidence, best = found[0]
        if rivalry.alternatives(best, found, [each for _, each in found]):
            self.reason = "ambiguous, because two groups of tags put the start in different places"
            return None
        fitting = {self._pairs[i][0] for i in np.flatnonzero(best.members)}
        if len(fitting) < LEAST_FITTING:
            self.reason = f"{len(fitting)} tags fit the map, {LEAST_FITTING} must, as any one may have been moved"
            return None
        if best.n_members < n and evidence <= CHANCE_NATS:
            self.reason = f"of {n} tags that may be the map's {best.n_members} fit, which chance may bring about"
            return None
        self.reason = ""
        return Start(best.T_a_b, tuple(self._pairs[i] for i in np.flatnonzero(best.members)))


class _RigidFit:
    """The map's tags against those seen, taken as pairs."""

    def __init__(self, known: MapPrior, seen: SeenTags, pairs: Sequence[tuple[int, TagKey]]) -> None:
        own = np.array([i for i, _ in pairs], dtype=np.int64)
        rows: IntArray = (2 * own[:, None] + np.arange(2)).reshape(-1)
        in_map = known.rows([tag for _, tag in pairs])
        self.n, self._own = len(pairs), own
        self.places_a, self.places_b = known.mean[in_map].reshape(-1, 2), seen.places_m[own]
        self._covariance_a = known.covariance[np.ix_(in_map, in_map)]
        self._covariance_b = seen.covariance[np.ix_(rows, rows)]

    def same_distances(self) -> list[tuple[int, int]]:
        """Which two pairs are of different tags that lie as far apart here as there."""
        first, second = np.triu_indices(self.n, 1)
        length_a, variance_a = distances(self.places_a, self._covariance_a, first, second)
        length_b, variance_b = distances(self.places_b, self._covariance_b, first, second)
        fits = is_same_distance(length_a, length_b, variance_a + variance_b + 2.0 * UNMODELLED_SIGMA_M**2)
        fits &= self._own[first] != self._own[second]
        return list(zip(first[fits].tolist(), second[fits].tolist(), strict=True))

    def grow(self, i: int, j: int) -> Hypothesis | None:
        """What fits with two pairs; None where they do not themselves."""
        members = np.zeros(self.n, dtype=np.bool_)
        members[[i, j]] = True
        T = transform_from_two_tags(self.places_a[[i, j]], self.places_b[[i, j]])
        for _ in range(_STEPS):
            held = fit_members(self._linear(T), members)
            T = held.T_a_b
            off, spread = held.predict_others()
            fitting = members | (gate_ratio(off, spread) < 1.0)
            if (fitting == members).all():
                break
            members = fitting
        held = fit_members(self._linear(T), members)
        return Hypothesis(members, held.linear, held) if held.is_consistent else None

    def _linear(self, T: FloatArray) -> LinearisedFit:
        cos, sin = np.cos(T[2]), np.sin(T[2])
        R = np.array([[cos, -sin], [sin, cos]])
        n = self.n
        turned = np.einsum("ab,ibjc,dc->iajd", R, self._covariance_b.reshape(n, 2, n, 2), R).reshape(2 * n, 2 * n)
        in_a = se2.apply(T, self.places_b)
        centre = in_a.mean(axis=0)
        by_transform = np.zeros((n, 2, 3))
        by_transform[:, :, :2] = -np.eye(2)
        by_transform[:, :, 2] = -rotate_quarter(in_a - centre)
        covariance = self._covariance_a + turned
        covariance[np.diag_indices(2 * n)] += UNMODELLED_SIGMA_M**2
        unbent = FitState(T, _NONE, _NONE)
        none = np.zeros((2 * n, 0))
        return LinearisedFit(
            unbent, centre, (self.places_a - in_a).reshape(-1), covariance, by_transform.reshape(-1, 3), none, none
        )
