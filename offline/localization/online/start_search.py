"""Searches for the start of a drive in a finished map, with bounded work for each observation.

As in `alignment.ransac`, each pair of tags is a hypothesis, which tags that agree with its prediction join. The drive
is still short and the map is taken in its own axes, so a hypothesis is a single rigid transform. The result is decided
when all pairs have been tested.
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
# Two tags are compared by their distance alone, which a tag that moved sideways keeps, so a wrong start would not be
# detected. With three, the others reveal any single tag that moved.
LEAST_FITTING: Final = 3
_NONE: Final = np.zeros(0)


@dataclass(frozen=True)
class SeenTags:
    """The observed tags in the frame of the robot's start.

    Attributes:
        tags: n keys without instance; places_m: (n, 2); covariance: (2 n, 2 n).
    """

    tags: tuple[TagKey, ...]
    places_m: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Start:
    """The start of a drive in the map.

    Attributes:
        T_map_start: (3,) approximate pose.
        tags: index of each fitting tag in `SeenTags`, with the map's tag.
    """

    T_map_start: FloatArray
    tags: tuple[tuple[int, TagKey], ...]


class StartSearch:
    """A search over pairs of observed tags, one at each call, that restarts with each new tag or without a result.

    Attributes:
        reason: why the start is not known; empty where it is.
    """

    def __init__(self, known: MapPrior) -> None:
        self._known = known
        self._pairs: list[tuple[int, TagKey]] = []
        self._untested: list[tuple[int, int]] | None = None  # pairs still to test; None before a restart
        self._found: list[Hypothesis] = []
        self.reason = "no tag of the map was observed yet"

    def search(self, seen: SeenTags) -> Start | None:
        """Test one more pair; return the start when it is certain, else None and set `reason`."""
        pairs = [(i, tag) for i, own in enumerate(seen.tags) for tag in self._known.instances.get(own, ())]
        if len({i for i, _ in pairs}) < 2:
            self.reason = f"{'one tag' if pairs else 'no tag'} of the map was observed; two are needed"
            return None
        fit = _RigidFit(self._known, seen, pairs)
        if pairs == self._pairs and self._untested is not None and not self._untested:
            self._untested = None
            return self._decide(fit)
        if pairs != self._pairs or self._untested is None:  # restart, with positions that are better known by now
            self._pairs, self._found, self._untested = pairs, [], fit.same_distances()
        else:
            found = fit.grow(*self._untested.pop(0))
            if found is not None:
                self._found.append(found)
                members = set(np.flatnonzero(found.members).tolist())
                self._untested = [pair for pair in self._untested if not set(pair) <= members]
        self.reason = "the search for the start is not finished"
        return None

    def _decide(self, fit: "_RigidFit") -> Start | None:
        n = fit.n
        if not self._found:
            self.reason = f"no two of the {n} tags that may be in the map have the same arrangement there"
            return None
        test = HypothesisTest(fit.places_a, fit.places_b)
        found = sorted(((test.log_bayes_factor(each), each) for each in self._found), key=lambda f: -f[0])
        log_bayes_factor, best = found[0]
        if test.alternatives(best, found, [each for _, each in found]):
            self.reason = "ambiguous, because two groups of tags put the start in different places"
            return None
        fitting = {self._pairs[i][0] for i in np.flatnonzero(best.members)}
        if len(fitting) < LEAST_FITTING:
            self.reason = f"{len(fitting)} tags fit the map; {LEAST_FITTING} are needed, because any one may have moved"
            return None
        if best.n_members < n and log_bayes_factor <= CHANCE_NATS:
            self.reason = f"of {n} tags that may be in the map only {best.n_members} fit, which may be chance"
            return None
        self.reason = ""
        return Start(best.T_a_b, tuple(self._pairs[i] for i in np.flatnonzero(best.members)))


class _RigidFit:
    """Rigid transforms between the map's tags (a) and the observed tags (b), given as pairs."""

    def __init__(self, known: MapPrior, seen: SeenTags, pairs: Sequence[tuple[int, TagKey]]) -> None:
        own = np.array([i for i, _ in pairs], dtype=np.int64)
        rows: IntArray = (2 * own[:, None] + np.arange(2)).reshape(-1)
        in_map = known.rows([tag for _, tag in pairs])
        self.n, self._own = len(pairs), own
        self.places_a, self.places_b = known.mean[in_map].reshape(-1, 2), seen.places_m[own]
        self._covariance_a = known.covariance[np.ix_(in_map, in_map)]
        self._covariance_b = seen.covariance[np.ix_(rows, rows)]

    def same_distances(self) -> list[tuple[int, int]]:
        """Return pairs of candidate matches, of different tags, that are equally far apart in map and drive."""
        first, second = np.triu_indices(self.n, 1)
        length_a, variance_a = distances(self.places_a, self._covariance_a, first, second)
        length_b, variance_b = distances(self.places_b, self._covariance_b, first, second)
        fits = is_same_distance(length_a, length_b, variance_a + variance_b + 2.0 * UNMODELLED_SIGMA_M**2)
        fits &= self._own[first] != self._own[second]
        return list(zip(first[fits].tolist(), second[fits].tolist(), strict=True))

    def grow(self, i: int, j: int) -> Hypothesis | None:
        """Return the hypothesis that grows from two pairs; None where its members are not consistent."""
        members = np.zeros(self.n, dtype=np.bool_)
        members[[i, j]] = True
        T = transform_from_two_tags(self.places_a[[i, j]], self.places_b[[i, j]])
        for _ in range(_STEPS):
            fit = fit_members(self._linear(T), members)
            T = fit.T_a_b
            off, covariance = fit.predict_others()
            fitting = members | (gate_ratio(off, covariance) < 1.0)
            if (fitting == members).all():
                break
            members = fitting
        fit = fit_members(self._linear(T), members)
        return Hypothesis(members, fit.linear, fit) if fit.is_consistent else None

    def _linear(self, T: FloatArray) -> LinearisedFit:
        cos, sin = np.cos(T[2]), np.sin(T[2])
        R = np.array([[cos, -sin], [sin, cos]])
        n = self.n
        rotated = np.einsum("ab,ibjc,dc->iajd", R, self._covariance_b.reshape(n, 2, n, 2), R).reshape(2 * n, 2 * n)
        in_a = se2.apply(T, self.places_b)
        centre = in_a.mean(axis=0)
        by_transform = np.zeros((n, 2, 3))
        by_transform[:, :, :2] = -np.eye(2)
        by_transform[:, :, 2] = -rotate_quarter(in_a - centre)
        covariance = self._covariance_a + rotated
        covariance[np.diag_indices(2 * n)] += UNMODELLED_SIGMA_M**2
        unbent = FitState(T, _NONE, _NONE)
        none = np.zeros((2 * n, 0))
        return LinearisedFit(
            unbent, centre, (self.places_a - in_a).reshape(-1), covariance, by_transform.reshape(-1, 3), none, none
        )
