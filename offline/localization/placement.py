"""Aligns a local map with a finished map, also where several tags of the map share an id.

A tag of the run may be any of the map's tags with its id. Each such pair is treated as a separate shared tag: pairs
that imply the same pose of the run fit together, and where two groups of pairs do, the pose is ambiguous.
"""

from dataclasses import dataclass, replace

import numpy as np

from groundsbot.offline.alignment import Alignment, CondensedMap, align, condense, variance_factor
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.measurements import TagKey


@dataclass(frozen=True)
class Located:
    """The alignment of a local map with one component of a map.

    Attributes:
        component: its index.
        local_map: local map of a segment of the run.
        pairs: tags of the run, each with a tag of the map that it may be.
        alignment: has its shared tags under the map's names; None where no two of them fit together.
    """

    component: int
    local_map: LocalMap
    pairs: tuple[tuple[TagKey, TagKey], ...]
    alignment: Alignment | None

    @property
    def is_certain(self) -> bool:
        """Whether the alignment is accepted, that is, likelier than chance and without alternatives."""
        return self.alignment is not None and self.alignment.is_accepted

    @property
    def shared(self) -> tuple[TagKey, ...]:
        """The map's tags that the run may have observed."""
        return tuple(dict.fromkeys(known for _, known in self.pairs))

    def matches(self) -> dict[TagKey, TagKey]:
        """Return the map's tag for each tag of the run that fits; pairs that are not one-to-one are left out."""
        if self.alignment is None:
            return {}
        fitting = [pair for pair, fits in zip(self.pairs, self.alignment.inlier, strict=True) if fits]
        own, known = ([pair[side] for pair in fitting] for side in (0, 1))
        return {seen: tag for seen, tag in fitting if own.count(seen) == 1 and known.count(tag) == 1}

    def mismatches(self) -> dict[TagKey, TagKey]:
        """Return the map's tag for each tag of the run that does not fit the only tag it may be."""
        matches, paired = self.matches(), [seen for seen, _ in self.pairs]
        taken = set(matches.values())
        return {
            seen: tag
            for seen, tag in self.pairs
            if seen not in matches and tag not in taken and paired.count(seen) == 1
        }


def locate(local_map: LocalMap, known: MapPrior, component: int) -> Located | None:
    """Align a local map with a component of a map; None where they share no tag id.

    Args:
        local_map: local map of a segment of the run.
        known: the component.
        component: its index.
    """
    seen = [tag for tag in local_map.graph.tags if tag.whole in known.instances]
    if not seen:
        return None
    pairs = [(tag, of_map) for tag in seen for of_map in known.instances[tag.whole]]
    # Sorted by name, because the alignment returns shared tags in that order.
    names = {pair: TagKey(pair[0].family, pair[0].tag_id, f"{i:06d}") for i, pair in enumerate(pairs)}
    pairs.sort(key=lambda pair: names[pair])
    ordered = [names[pair] for pair in pairs]
    own = condense(local_map, seen, variance_factor(local_map))
    alignment = align(
        known.condense([of_map for _, of_map in pairs], ordered),
        _repeat_tags(own, [seen.index(tag) for tag, _ in pairs], ordered),
    )
    if alignment is not None:
        alignment = _with_map_names(alignment, tuple(of_map for _, of_map in pairs))
    return Located(component, local_map, tuple(pairs), alignment)


def _repeat_tags(condensed: CondensedMap, which: list[int], names: list[TagKey]) -> CondensedMap:
    """Return a condensed map of tags selected by index, under other names."""
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
    alternatives = tuple(_with_map_names(each, tags) for each in alignment.alternatives)
    return replace(alignment, shared=tags, alternatives=alternatives)
