"""A finished map as what is known beforehand: where its tags are and what the calibration is, jointly.

Errors are taken in map axes here, where `alignment.condensed_map` takes those of a local map along its drive. A run
that is placed in the map sees its tags from near by, and is itself free to turn with them; what is turned by a degree
against the map's axes makes tags 2 m apart come out 0.3 mm nearer.
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

# Far below what a tag's place is ever known to, and far above rounding.
_LEAST_SIGMA_M: Final = 1e-6


@dataclass(frozen=True)
class MapPrior:
    """The tags of one component whose places mean something, and its calibration.

    Attributes:
        frame_run: whose start is the frame.
        tags: (T,)
        places_m: (T, 2) in map.
        calibration: (C,) what was found; its own covariances are not used.
        covariance: (2 T + C, 2 T + C) of places, then calibration.
    """

    frame_run: str
    tags: tuple[TagKey, ...]
    places_m: FloatArray
    calibration: ArchivedCalibration
    covariance: FloatArray

    @property
    def mean(self) -> FloatArray:
        """(2 T + C,) places, then calibration."""
        return np.concatenate([self.places_m.reshape(-1), self.calibration.values])

    @cached_property
    def index(self) -> dict[TagKey, int]:
        """Of each tag."""
        return {tag: i for i, tag in enumerate(self.tags)}

    @cached_property
    def instances(self) -> dict[TagKey, tuple[TagKey, ...]]:
        """The tags of each id."""
        found: dict[TagKey, list[TagKey]] = {}
        for tag in self.tags:
            found.setdefault(tag.whole, []).append(tag)
        return {whole: tuple(tags) for whole, tags in found.items()}

    def rows(self, tags: Sequence[TagKey], numbers: Sequence[int] = ()) -> IntArray:
        """Rows of the covariance: of tags, then of calibration numbers."""
        which = np.array([self.index[tag] for tag in tags], dtype=np.int64)
        of_tags = (2 * which[:, None] + np.arange(2)).reshape(-1)
        return np.concatenate([of_tags, 2 * len(self.tags) + np.array(numbers, dtype=np.int64)])

    def condense(self, tags: Sequence[TagKey], names: Sequence[TagKey]) -> CondensedMap:
        """Some tags, one or several times, under other names, for an alignment."""
        n, rows = len(tags), self.rows(tags)
        covariance = np.zeros((5 * n, 5 * n))
        covariance[3 * n :, 3 * n :] = self.covariance[np.ix_(rows, rows)]
        return CondensedMap("the map", tuple(names), np.zeros((n, 3)), self.mean[rows].reshape(n, 2), covariance, 0)

    def constrain(self, graph: Graph, names: Mapping[TagKey, TagKey]) -> Graph:
        """The graph with the map's tags and calibration as what is known of them.

        Args:
            graph: of runs.
            names: the map's tag of each of the graph's tags that is one.
        """
        known = self._prior(graph, names)
        prior = graph.problem.prior
        sigma = prior.sigma.copy()
        sigma[known.calibration] = np.inf  # what robot.yaml says of these is in the map already
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
        """Index among the map's calibration of each free parameter, by its own index, that the map knows."""
        own = self.calibration
        known = {
            (owner, name, _key(row)): i
            for i, (owner, name, row) in enumerate(zip(own.owners, own.names, own.nominal, strict=True))
        }
        wanted = {i: (p.owner, p.name, _key(nominal_row(p.nominal))) for i, p in enumerate(parameters) if p.sigma}
        return {i: known[key] for i, key in wanted.items() if key in known}


def prior_from_map(component: Component, where: str) -> MapPrior:
    """What a component of a map tells of the places of its tags.

    Args:
        component: of the map.
        where: the map's folder, for errors.

    Raises:
        OfflineError: the map holds numbers that are none.
    """
    calibration = component.calibration or ArchivedCalibration(
        (), (), np.zeros((0, 4)), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 2 * len(component.tags)))
    )
    places = np.array([tag.position_m for tag in component.tags]).reshape(-1, 2)
    joint = np.block(
        [[component.tag_covariance, calibration.with_tags.T], [calibration.with_tags, calibration.covariance]]
    )
    if not (np.isfinite(joint).all() and np.isfinite(places).all()):
        raise OfflineError(f"{where}: a tag's place or covariance is no number; make the map again")
    variances = np.diag(joint)[: 2 * len(places)].reshape(-1, 2)
    is_told = np.asarray(variances.max(axis=1, initial=0.0) < REACH_M**2)  # else it may be anywhere
    kept = np.flatnonzero(np.concatenate([np.repeat(is_told, 2), np.ones(len(calibration.values), dtype=np.bool_)]))
    tags = [TagKey(tag.family, tag.tag_id, tag.instance) for tag in component.tags]
    covariance = joint[np.ix_(kept, kept)]
    of_tags = np.arange(2 * int(is_told.sum()))
    covariance[of_tags, of_tags] += _LEAST_SIGMA_M**2
    return MapPrior(
        component.frame_run,
        tuple(tag for tag, told in zip(tags, is_told.tolist(), strict=True) if told),
        places[is_told],
        calibration,
        covariance,
    )


def _key(row: FloatArray) -> tuple[float, ...]:
    """Of what is nominal, to be compared."""
    return tuple(value for value in row.tolist() if value == value)
