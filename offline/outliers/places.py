"""Tracks gathered into places: where these lie, and what every split of one would bring, all else giving way."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy import linalg

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.outliers.evidence import Evidence
from groundsbot.offline.outliers.joint_information import Information, PlaceInformation, rows_of

# A place is somewhere within a kilometre: ties down what no observation does.
NOWHERE: Final = 1e-6
_AT_ONCE: Final = 256  # tracks


@dataclass(frozen=True)
class Stiffness:
    """L less what places give way, L - U C U' (2 K, 2 K), of which only small parts are ever worked out.

    Attributes:
        information: (2 K, 2 K) L, of the evidence.
        gathered: the same between tracks and places, U.
        covariance: (2 P, 2 P) C of the places.
    """

    information: Information
    gathered: PlaceInformation
    covariance: FloatArray

    def among_each(self, parts: Sequence[IntArray]) -> Iterator[FloatArray]:
        """(2 m, 2 m) between the tracks of each part."""
        for batch in _batches(parts):
            across = self.gathered.across(rows_of(np.concatenate(batch)))
            give_way = across @ self.covariance
            end = 0
            for members in batch:
                begin, end = end, end + 2 * len(members)
                yield self.information.among(rows_of(members)) - give_way[begin:end] @ across[begin:end].T

    def together(self, members: IntArray) -> FloatArray:
        """(2, 2) of some tracks moved as one."""
        (among,) = self.among_each([members])
        return np.asarray(among.reshape(len(members), 2, -1, 2).sum(axis=(0, 2)))

    def against(self, members: IntArray) -> FloatArray:
        """(2 K, 2) what all feel of some tracks moved as one."""
        moved = np.zeros((len(self.gathered.column), 2))
        moved[rows_of(members)] = np.tile(np.eye(2), (len(members), 1))
        way = self.covariance @ self.gathered.sum_by_place(self.information.times(moved))
        return self.information.times(moved - way[self.gathered.column])


class TracksOfPlace(NamedTuple):
    """The tracks of one place.

    Attributes:
        members: (m,) of those of the evidence.
        stiffness: (2 m, 2 m) between them; pull: (m, 2).
    """

    members: IntArray
    stiffness: FloatArray
    pull: FloatArray

    def of(self, which: BoolArray) -> "TracksOfPlace":
        """Some of them (m,)."""
        rows = np.repeat(which, 2)
        return TracksOfPlace(self.members[which], self.stiffness[np.ix_(rows, rows)], self.pull[which])

    def release(self, against: FloatArray, inner: FloatArray, own: FloatArray) -> "TracksOfPlace":
        """Once what felt `against` (2 K, 2) of all with `inner` (2, 2) has followed its pull (2,)."""
        felt = against[rows_of(self.members)]
        way = np.linalg.solve(inner, felt.T)
        return TracksOfPlace(self.members, self.stiffness - felt @ way, self.pull - (own @ way).reshape(-1, 2))

    def gains(self, masks: FloatArray) -> FloatArray:
        """(n,) what it brings to give some of them (n, m) another place, each choice by itself; in squared sigmas."""
        m = len(self.members)
        by_first = (masks @ self.stiffness.reshape(m, -1)).reshape(-1, 2, m, 2)
        inner = np.einsum("najb,nj->nab", by_first, masks) + NOWHERE * np.eye(2)
        own = masks @ self.pull
        return np.asarray(np.einsum("ni,ni->n", own, np.linalg.solve(inner, own[..., None])[..., 0]))


@dataclass(frozen=True)
class Places:
    """Tracks gathered into places, and where these are.

    Attributes:
        place: (K,) of each track of the evidence, 0 to P - 1.
        offset: (2 P,) of the places from the middle of their tracks' in the evidence; covariance: (2 P, 2 P).
        pull: (K, 2) by which each track would rather be elsewhere; stiffness: against that.
    """

    place: IntArray
    offset: FloatArray
    covariance: FloatArray
    pull: FloatArray
    stiffness: Stiffness

    @cached_property
    def tracks(self) -> list["TracksOfPlace"]:
        """Of each place its tracks."""
        order = np.argsort(self.place, kind="stable")
        parts = np.split(order, np.cumsum(np.bincount(self.place))[:-1]) if len(order) else []
        return [
            TracksOfPlace(each, among, self.pull[each])
            for each, among in zip(parts, self.stiffness.among_each(parts), strict=True)
        ]

    def apart(self, evidence: Evidence, p: int, q: int) -> tuple[FloatArray, FloatArray]:
        """Place q as seen from place p (2,), and its covariance (2, 2)."""
        rows = np.concatenate([2 * p + np.arange(2), 2 * q + np.arange(2)])
        difference = np.hstack([-np.eye(2), np.eye(2)])
        covariance = difference @ self.covariance[np.ix_(rows, rows)] @ difference.T
        return self.at(evidence, q) - self.at(evidence, p), covariance

    def at(self, evidence: Evidence, p: int) -> FloatArray:
        """(2,) of place p."""
        middle = evidence.places_m[np.flatnonzero(self.place == p)].mean(axis=0)
        return np.asarray(middle + self.offset[2 * p : 2 * p + 2])


def minimise_places(evidence: Evidence, place: IntArray) -> Places:
    """The least cost where tracks (K,) of one label have one place."""
    _, place = np.unique(place, return_inverse=True)
    n = int(place.max(initial=-1)) + 1
    # Tracks of one place may have been linearised at several; they are taken from the middle of these.
    sums = np.zeros((n, 2))
    np.add.at(sums, place, evidence.places_m)
    middle = sums / np.bincount(place, minlength=n)[:, None]
    information = evidence.information
    gathered = information.gather(place, n)
    to_middle = (middle[place] - evidence.places_m).reshape(-1, 1)
    score = evidence.score + information.times(to_middle)[:, 0]
    covariance = linalg.inv(gathered.whole() + NOWHERE * np.eye(2 * n), check_finite=False)
    offset: FloatArray = -covariance @ gathered.sum_by_place(score[:, None])[:, 0]
    pull = score + information.times(offset[gathered.column, None])[:, 0]
    return Places(place, offset, covariance, pull.reshape(-1, 2), Stiffness(information, gathered, covariance))


def _batches(parts: Sequence[IntArray]) -> Iterator[list[IntArray]]:
    """Several parts at a time: what lies between them and all places goes through the whole root each time."""
    batch: list[IntArray] = []
    for each in parts:
        batch.append(each)
        if sum(map(len, batch)) >= _AT_ONCE:
            yield batch
            batch = []
    if batch:
        yield batch
