"""A finished map as a joint prior on tag positions and calibration.

Errors are in map axes, while `alignment.condensed_map` has those of a local map in axes along its drive. A run observes
the map's tags from nearby and is free to rotate with them, so a linear approximation suffices: after a rotation by one
degree, tags 2 m apart are 0.3 mm too close.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.alignment import CondensedMap
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.maps import ArchivedCalibration, Component, nominal_row
from groundsbot.offline.measurements import REACH_M, TagKey
from groundsbot.offline.sam import NO_PRIORS, Graph, JointPrior, Parameter, whitening

# Far below the sigma of any tag, and large enough for the solve to turn the map within it; at 1e-6 m it stops early.
# Where tags hold the frame, their covariance is singular along its motion (`maps.frame`), so this is the frame's sigma
# there.
_LEAST_SIGMA_M: Final = 1e-4


@dataclass(frozen=True)
class MapPrior:
    """The joint prior from one component of a map: its tags of known position, and its calibration.

    Attributes:
        frame_run: the run whose start is the frame; None where tags hold it.
        tags: T keys.
        places_m: (T, 2) in map.
        calibration: C estimated parameters; the covariances in it are not used.
        covariance: (2 T + C, 2 T + C) of positions, then calibration.
    """

    frame_run: str | None
    tags: tuple[TagKey, ...]
    places_m: FloatArray
    calibration: ArchivedCalibration
    covariance: FloatArray

    @property
    def mean(self) -> FloatArray:
        """(2 T + C,) positions, then calibration."""
        return np.concatenate([self.places_m.reshape(-1), self.calibration.values])

    @cached_property
    def index(self) -> dict[TagKey, int]:
        """The index of each tag."""
        return {tag: i for i, tag in enumerate(self.tags)}

    @cached_property
    def instances(self) -> dict[TagKey, tuple[TagKey, ...]]:
        """The tags that share each id, by the key without instance."""
        found: dict[TagKey, list[TagKey]] = {}
        for tag in self.tags:
            found.setdefault(tag.whole, []).append(tag)
        return {whole: tuple(tags) for whole, tags in found.items()}

    def rows(self, tags: Sequence[TagKey], numbers: Sequence[int] = ()) -> IntArray:
        """Return the rows in the covariance of tags, then of calibration parameters by index."""
        which = np.array([self.index[tag] for tag in tags], dtype=np.int64)
        of_tags = (2 * which[:, None] + np.arange(2)).reshape(-1)
        return np.concatenate([of_tags, 2 * len(self.tags) + np.array(numbers, dtype=np.int64)])

    def condense(self, tags: Sequence[TagKey], names: Sequence[TagKey]) -> CondensedMap:
        """Return the map condensed to some tags for an alignment.

        Args:
            tags: n tags of the map; one may occur several times.
            names: (n,) keys that they get in the result.
        """
        n, rows = len(tags), self.rows(tags)
        covariance = np.zeros((5 * n, 5 * n))
        covariance[3 * n :, 3 * n :] = self.covariance[np.ix_(rows, rows)]
        return CondensedMap("the map", tuple(names), np.zeros((n, 3)), self.mean[rows].reshape(n, 2), covariance, 0)

    def constrain(self, graph: Graph, names: Mapping[TagKey, TagKey]) -> Graph:
        """Return the graph with this prior on its tags and calibration.

        Args:
            graph: graph of runs.
            names: the map's tag for each tag of the graph that is in the map.
        """
        known = self._prior(graph, names)
        prior = graph.problem.prior
        sigma = prior.sigma.copy()
        sigma[known.calibration] = np.inf  # the map already contains the prior of robot.yaml on these
        measured = replace(NO_PRIORS, known=known)
        return replace(graph, problem=replace(graph.problem, prior=replace(prior, sigma=sigma), measured=measured))

    def _prior(self, graph: Graph, names: Mapping[TagKey, TagKey]) -> JointPrior:
        tags = [tag for tag in graph.tags if tag in names]
        numbers = self.numbers_among(graph.parameters)
        rows = self.rows([names[tag] for tag in tags], list(numbers.values()))
        return JointPrior(
            tags=np.array([graph.tags.index(tag) for tag in tags], dtype=np.int64),
            calibration=np.array(list(numbers), dtype=np.int64),
            mean=self.mean[rows],
            whitening=whitening(self.covariance[np.ix_(rows, rows)]),
        )

    def numbers_among(self, parameters: Sequence[Parameter]) -> dict[int, int]:
        """Return the index in the map's calibration, by index in `parameters`, of the free ones that the map has."""
        own = self.calibration
        known = {
            (owner, name, _key(row)): i
            for i, (owner, name, row) in enumerate(zip(own.owners, own.names, own.nominal, strict=True))
        }
        wanted = {i: (p.owner, p.name, _key(nominal_row(p.nominal))) for i, p in enumerate(parameters) if p.sigma}
        return {i: known[key] for i, key in wanted.items() if key in known}


def prior_from_map(component: Component, where: str) -> MapPrior:
    """Return the joint prior from a component of a map.

    Tags with a sigma of `REACH_M` or more are left out.

    Args:
        component: component of the map.
        where: the map's folder, for errors.

    Raises:
        OfflineError: a position or covariance is not finite.
    """
    calibration = component.calibration or ArchivedCalibration(
        (), (), np.zeros((0, 4)), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 2 * len(component.tags)))
    )
    places = np.array([tag.position_m for tag in component.tags]).reshape(-1, 2)
    joint = np.block(
        [[component.tag_covariance, calibration.with_tags.T], [calibration.with_tags, calibration.covariance]]
    )
    if not (np.isfinite(joint).all() and np.isfinite(places).all()):
        raise OfflineError(f"{where}: a tag's position or covariance is not finite; make the map again")
    variances = np.diag(joint)[: 2 * len(places)].reshape(-1, 2)
    is_known = np.asarray(variances.max(axis=1, initial=0.0) < REACH_M**2)
    kept = np.flatnonzero(np.concatenate([np.repeat(is_known, 2), np.ones(len(calibration.values), dtype=np.bool_)]))
    covariance = joint[np.ix_(kept, kept)]
    of_tags = np.arange(2 * int(is_known.sum()))
    covariance[of_tags, of_tags] += _LEAST_SIGMA_M**2
    tags = tuple(
        TagKey(tag.family, tag.tag_id, tag.instance)
        for tag, known in zip(component.tags, is_known.tolist(), strict=True)
        if known
    )
    return MapPrior(component.frame_run, tags, places[is_known], calibration, covariance)


def _key(row: FloatArray) -> tuple[float, ...]:
    """Return the nominal values of a row without NaN padding, for comparison."""
    return tuple(value for value in row.tolist() if value == value)
