"""Sentences about weakly determined parts of a map: unobservable runs, tags seen once, rounding."""

from collections import Counter
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import MAX_RELATIVE_ERROR, Graph, Solution

_MOST_NAMED: Final = 12


def weak_constraint_warnings(graph: Graph, solution: Solution) -> list[str]:
    """Return sentences about one component."""
    return [
        *_unobservable_warnings(graph, solution),
        *_single_observation_warnings(graph),
        *_rounding_warnings(graph, solution),
    ]


def _unobservable_warnings(graph: Graph, solution: Solution) -> list[str]:
    """Return sentences about segments that are not fully observable."""
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
            reason = f"is connected to the others by {_list_tags(shared)} alone, which leaves it free to move"
        sentences.append(
            f"{segment.name} {reason}; its pose in this map is not determined, nor are the positions of tags that it "
            "alone saw"
        )
    return sentences


def _single_observation_warnings(graph: Graph) -> list[str]:
    """Return a sentence about tags with a single observation."""
    observations = graph.problem.observations
    once: IntArray = np.flatnonzero(graph.n_observations()[observations.tag] == 1)
    if not len(once):
        return []
    first, second = observations.value[once].T
    range_m = np.where(observations.polar[once], first, np.hypot(first, second))
    segment = np.searchsorted(graph.first_pose, observations.pose[once], side="right") - 1
    names = [graph.segments[c].name for c in segment]
    tags = [graph.tags[t].tag_id for t in observations.tag[once]]
    if len(once) == 1:
        return [f"tag {tags[0]} was seen once, from {range_m[0]:.1f} m, by {names[0]}; its place is unchecked"]
    named = [f"{tag} (from {far:.1f} m, {name})" for tag, far, name in zip(tags, range_m, names, strict=True)]
    more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    return [f"tags {', '.join(named[:_MOST_NAMED])}{more} were seen once each; their places are unchecked"]


def _rounding_warnings(graph: Graph, solution: Solution) -> list[str]:
    """Return a sentence about a solve beyond double precision."""
    error = solution.relative_error()
    if error <= MAX_RELATIVE_ERROR:
        return []
    reason = "sigmas of very different size, or a long drive past too few tags"
    return [f"{graph.segments[0].name}: rounding makes the covariances of its map wrong ({reason}); do not trust them"]


def _list_tags(tags: list[TagKey]) -> str:
    return "tags " + ", ".join(str(tag.tag_id) for tag in tags)
