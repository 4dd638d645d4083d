"""What a map holds only weakly or not at all, in words: tags seen once, runs that nothing ties, rounding."""

from collections import Counter
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import MAX_RELATIVE_ERROR, Graph, Solution

_MOST_NAMED: Final = 12


def weak_parts(graph: Graph, solution: Solution) -> list[str]:
    """Sentences about one component."""
    return [
        *_unobservable_warnings(graph, solution),
        *_single_observation_warnings(graph),
        *_rounding_warnings(graph, solution),
    ]


def _unobservable_warnings(graph: Graph, solution: Solution) -> list[str]:
    """Of segments that can still move without any measurement noticing."""
    seen_by = Counter(tag for segment in graph.segments for tag in segment.tags)
    sentences = []
    for index in solution.unobservable.segments:
        segment = graph.segments[index]
        shared = [tag for tag in segment.tags if seen_by[tag] > 1]
        if not shared:
            reason = "shares no tag with the others"
        elif len(shared) == 1:
            reason = f"shares only tag {shared[0].tag_id} with the others, about which it can turn"
        else:
            reason = f"hangs on the others by {_list_tags(shared)} alone, which leaves it free to move"
        sentences.append(
            f"{segment.name} {reason}; its place in this map means nothing, nor do those of tags it alone saw"
        )
    return sentences


def _single_observation_warnings(graph: Graph) -> list[str]:
    """Of tags that rest on a single reading."""
    readings = graph.problem.readings
    once: IntArray = np.flatnonzero(graph.n_readings()[readings.tag] == 1)
    if not len(once):
        return []
    first, second = readings.value[once].T
    range_m = np.where(readings.polar[once], first, np.hypot(first, second))
    segment = np.searchsorted(graph.first_pose, readings.pose[once], side="right") - 1
    names = [graph.segments[c].name for c in segment]
    tags = [graph.tags[t].tag_id for t in readings.tag[once]]
    if len(once) == 1:
        return [f"tag {tags[0]} was seen once, from {range_m[0]:.1f} m, by {names[0]}; nothing checks its place"]
    named = [f"{tag} (from {far:.1f} m, {name})" for tag, far, name in zip(tags, range_m, names, strict=True)]
    more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    return [f"tags {', '.join(named[:_MOST_NAMED])}{more} were seen once each; nothing checks their places"]


def _rounding_warnings(graph: Graph, solution: Solution) -> list[str]:
    """Of a solve that double precision does not carry."""
    error = solution.relative_error()
    if error <= MAX_RELATIVE_ERROR:
        return []
    reason = "sigmas of very different size, or a long drive past too few tags"
    return [f"{graph.segments[0].name}: rounding spoils the covariances of its map ({reason}); do not trust them"]


def _list_tags(tags: list[TagKey]) -> str:
    return "tags " + ", ".join(str(tag.tag_id) for tag in tags)
