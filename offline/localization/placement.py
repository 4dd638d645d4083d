"""How a local map lies in a finished map: the alignment of their tags, an id that hangs in several places included.

A tag of the run may be any of the map's tags with its id. So each such pair counts as a shared tag of its own: pairs
that put the run in one place fit together, and where two groups of pairs do, the place is ambiguous.
"""

from dataclasses import dataclass, replace

import numpy as np

from groundsbot.offline.alignment import Alignment, CondensedMap, align, condense, variance_factor
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.measurements import TagKey


@dataclass(frozen=True)
class Located:
    """A local map against one component of a map.

    Attributes:
        component: its index.
        pairs: of the run's tags with the map's.
        alignment: its shared tags under the map's names; None where no two of them fit together.
    """

    component: int
    local_map: LocalMap
    pairs: tuple[tuple[TagKey, TagKey], ...]
    alignment: Alignment | None

    @property
    def is_sure(self) -> bool:
        """Whether nothing else explains the tags as well."""
        return self.alignment is not None and self.alignment.is_accepted

    @property
    def shared(self) -> tuple[TagKey, ...]:
        """The map's tags that the run may have seen."""
        return tuple(dict.fromkeys(known for _, known in self.pairs))

    def names(self) -> dict[TagKey, TagKey]:
        """The map's tag of each of the run's that fits one; none where it fits several, or several fit one."""
        if self.alignment is None:
            return {}
        fitting = [pair for pair, fits in zip(self.pairs, self.alignment.inlier, strict=True) if fits]
        own, known = ([pair[side] for pair in fitting] for side in (0, 1))
        return {seen: tag for seen, tag in fitting if own.count(seen) == 1 and known.count(tag) == 1}

    def others(self) -> dict[TagKey, TagKey]:
        """That of those that may be one of the map's, and do not fit."""
        fitting, of_one = self.names(), [seen for seen, _ in self.pairs]
        taken = set(fitting.values())
        return {
            seen: tag
            for seen, tag in self.pairs
            if seen not in fitting and tag not in taken and of_one.count(seen) == 1
        }


def locate(local_map: LocalMap, known: MapPrior, component: int) -> Located | None:
    """Looks for the run's place; None where it saw none of the map's tags."""
    seen = [tag for tag in local_map.graph.tags if tag.whole in known.instances]
    if not seen:
        return None
    pairs = [(tag, of_map) for tag in seen for of_map in known.instances[tag.whole]]
    # Sorted as their names are: the alignment tells of shared tags in that order.
    names = {pair: TagKey(pair[0].family, pair[0].tag_id, f"{i:06d}") for i, pair in enumerate(pairs)}
    pairs.sort(key=lambda pair: names[pair])
    ordered = [names[pair] for pair in pairs]
    own = condense(local_map, seen, variance_factor(local_map))
    alignment = align(
        known.condense([of_map for _, of_map in pairs], ordered),
        _repeat_tags(own, [seen.index(tag) for tag, _ in pairs], ordered),
    )
    told = None if alignment is None else _with_map_names(alignment, tuple(of_map for _, of_map in pairs))
    return Located(component, local_map, tuple(pairs), told)


def _repeat_tags(condensed: CondensedMap, which: list[int], names: list[TagKey]) -> CondensedMap:
    """Tags by index, under other names."""
    n, at = len(condensed.tags), np.array(which, dtype=np.int64)
    rows = np.concatenate(
        [(3 * at[:, None] + np.arange(3)).reshape(-1), (3 * n + 2 * at[:, None] + np.arange(2)).reshape(-1)]
    )
    return CondensedMap(
        condensed.name,
        tuple(names),
        condensed.T_start_anchor[at],
        condensed.tag_m[at],
        condensed.covariance[np.ix_(rows, rows)],
        which.index(condensed.root),
    )


def _with_map_names(alignment: Alignment, tags: tuple[TagKey, ...]) -> Alignment:
    """With the tags under the map's own names."""
    rivals = tuple(_with_map_names(rival, tags) for rival in alignment.alternatives)
    return replace(alignment, shared=tags, alternatives=rivals)
