"""Places that tracks share: their positions, and the decrease of the cost by any split, with all else re-estimated."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy import linalg

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.outliers.evidence import Evidence
from groundsbot.offline.outliers.joint_information import Information, PlaceInformation, rows_of

# Information of a prior of 1 km on each place, in 1/m^2. It regularises what no observation determines.
NOWHERE: Final = 1e-6
_AT_ONCE: Final = 256  # tracks


@dataclass(frozen=True)
class Stiffness:
    """Information about tracks with the places eliminated: the Schur complement L - U C U' (2 K, 2 K), in 1/m^2.

    Only small parts of it are computed.

    Attributes:
        information: (2 K, 2 K) L, of the evidence.
        gathered: U, the information (2 K, 2 P) between tracks and places.
        covariance: (2 P, 2 P) C, of the places.
    """

    information: Information
    gathered: PlaceInformation
    covariance: FloatArray

    def among_each(self, parts: Sequence[IntArray]) -> Iterator[FloatArray]:
        """Yield the block (2 m, 2 m) of the tracks of each part."""
        for batch in _batches(parts):
            across = self.gathered.across(rows_of(np.concatenate(batch)))
            by_covariance = across @ self.covariance
            end = 0
            for members in batch:
                begin, end = end, end + 2 * len(members)
                yield self.information.among(rows_of(members)) - by_covariance[begin:end] @ across[begin:end].T

    def together(self, members: IntArray) -> FloatArray:
        """Return the information (2, 2) about a common shift of some tracks."""
        (among,) = self.among_each([members])
        return np.asarray(among.reshape(len(members), 2, -1, 2).sum(axis=(0, 2)))

    def against(self, members: IntArray) -> FloatArray:
        """Return the information (2 K, 2) between all tracks and a common shift of some of them."""
        shift = np.zeros((len(self.gathered.column), 2))
        shift[rows_of(members)] = np.tile(np.eye(2), (len(members), 1))
        place_shift = self.covariance @ self.gathered.sum_by_place(self.information.times(shift))
        return self.information.times(shift - place_shift[self.gathered.column])


class TracksOfPlace(NamedTuple):
    """The tracks of one place.

    Attributes:
        members: (m,) indices among the tracks of the evidence.
        stiffness: (2 m, 2 m) block of `Stiffness`.
        gradient: (m, 2) of the cost by each track's own place.
    """

    members: IntArray
    stiffness: FloatArray
    gradient: FloatArray

    def of(self, which: BoolArray) -> "TracksOfPlace":
        """Return some of the tracks (m,)."""
        rows = np.repeat(which, 2)
        return TracksOfPlace(self.members[which], self.stiffness[np.ix_(rows, rows)], self.gradient[which])

    def eliminate(self, coupling: FloatArray, inner: FloatArray, own: FloatArray) -> "TracksOfPlace":
        """Return the same tracks after another place was freed and eliminated (Schur complement); K tracks in all.

        Args:
            coupling: (2 K, 2) information between all tracks and the freed place.
            inner: (2, 2) information about the freed place.
            own: (2,) gradient of the cost by the freed place.
        """
        across = coupling[rows_of(self.members)]
        step = np.linalg.solve(inner, across.T)
        gradient = self.gradient - (own @ step).reshape(-1, 2)
        return TracksOfPlace(self.members, self.stiffness - across @ step, gradient)

    def gains(self, masks: FloatArray) -> FloatArray:
        """Return the decrease (n,) of the cost, in squared sigmas, if the tracks of a mask (n, m) get another place.

        Each of the n masks is evaluated by itself.
        """
        m = len(self.members)
        by_first = (masks @ self.stiffness.reshape(m, -1)).reshape(-1, 2, m, 2)
        inner = np.einsum("najb,nj->nab", by_first, masks) + NOWHERE * np.eye(2)
        own = masks @ self.gradient
        return np.asarray(np.einsum("ni,ni->n", own, np.linalg.solve(inner, own[..., None])[..., 0]))


@dataclass(frozen=True)
class Places:
    """Minimum of the cost of the evidence where tracks share P places.

    Attributes:
        place: (K,) place of each track of the evidence, 0 to P - 1.
        offset: (2 P,) position of each place relative to the mean linearisation point of its tracks, in metres.
        covariance: (2 P, 2 P) of the places, in m^2.
        gradient: (K, 2) of the cost by each track's own place, in 1/m.
        stiffness: second derivative of the cost with respect to the tracks' own places, with all else eliminated.
    """

    place: IntArray
    offset: FloatArray
    covariance: FloatArray
    gradient: FloatArray
    stiffness: Stiffness

    @cached_property
    def tracks(self) -> list[TracksOfPlace]:
        """Tracks of each place."""
        order = np.argsort(self.place, kind="stable")
        parts = np.split(order, np.cumsum(np.bincount(self.place))[:-1]) if len(order) else []
        return [
            TracksOfPlace(each, among, self.gradient[each])
            for each, among in zip(parts, self.stiffness.among_each(parts), strict=True)
        ]

    def apart(self, evidence: Evidence, p: int, q: int) -> tuple[FloatArray, FloatArray]:
        """Return the offset (2,) of place q from place p, in metres, and its covariance (2, 2)."""
        rows = np.concatenate([2 * p + np.arange(2), 2 * q + np.arange(2)])
        difference = np.hstack([-np.eye(2), np.eye(2)])
        covariance = difference @ self.covariance[np.ix_(rows, rows)] @ difference.T
        return self.at(evidence, q) - self.at(evidence, p), covariance

    def at(self, evidence: Evidence, p: int) -> FloatArray:
        """Return the position (2,) of place p, in metres."""
        middle = evidence.places_m[self.place == p].mean(axis=0)
        return np.asarray(middle + self.offset[2 * p : 2 * p + 2])


def minimise_places(evidence: Evidence, place: IntArray) -> Places:
    """Minimise the cost of the evidence, with one place for all tracks of equal label (K,)."""
    _, place = np.unique(place, return_inverse=True)
    n = int(place.max(initial=-1)) + 1
    # Tracks of one place may have different linearisation points; offsets refer to the mean of these.
    sums = np.zeros((n, 2))
    np.add.at(sums, place, evidence.places_m)
    middle = sums / np.bincount(place, minlength=n)[:, None]
    information = evidence.information
    gathered = information.gather(place, n)
    to_middle = (middle[place] - evidence.places_m).reshape(-1, 1)
    score = evidence.score + information.times(to_middle)[:, 0]
    whole = gathered.whole()
    whole[np.diag_indices(2 * n)] += NOWHERE
    # The transpose of the symmetric matrix, in Fortran's order, is inverted in place; else this takes three more.
    covariance = linalg.inv(whole.T, overwrite_a=True, check_finite=False)
    offset: FloatArray = -(covariance @ gathered.sum_by_place(score[:, None])[:, 0])
    gradient = score + information.times(offset[gathered.column, None])[:, 0]
    return Places(place, offset, covariance, gradient.reshape(-1, 2), Stiffness(information, gathered, covariance))


def _batches(parts: Sequence[IntArray]) -> Iterator[list[IntArray]]:
    """Yield several parts at a time, since each block between tracks and places needs a product with the whole root."""
    batch: list[IntArray] = []
    for each in parts:
        batch.append(each)
        if sum(map(len, batch)) >= _AT_ONCE:
            yield batch
            batch = []
    if batch:
        yield batch
