"""Reasons why runs were not joined, as sentences."""

from collections.abc import Sequence
from math import degrees

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.alignment.pairwise import Alignment
from groundsbot.offline.measurements import TagKey

_MOST_NAMED = 8


def reason_not_joined(a: str, b: str, shared: Sequence[TagKey], alignment: Alignment | None) -> str:
    """Return why run b is not joined to a, by name; they share at least one tag."""
    if alignment is not None and alignment.alternatives:
        return _ambiguous(a, b, alignment)
    if len(shared) == 1:
        return f"{b} shares only tag {shared[0].tag_id} with {a}; one more shared tag would suffice"
    if alignment is not None and alignment.is_accepted:
        return f"the alignment of {b} with {a} contradicts those of other runs"
    if alignment is not None:
        return (
            f"of the {len(shared)} tags that {b} shares with {a} only {_names(alignment.inliers)} have the same "
            "arrangement in both maps, which may be chance; were tags moved between the runs? One more unmoved shared "
            "tag would suffice"
        )
    return (
        f"{b} shares {len(shared)} tags with {a}, but no two of them fit together in both maps: "
        "were tags moved between the runs? Two unmoved shared tags would suffice"
    )


def _ambiguous(a: str, b: str, alignment: Alignment) -> str:
    ways = [alignment, *alignment.alternatives]
    first = set(alignment.inliers)
    parts = [f"tags {_names(ways[0].inliers)} put {b}'s start at {_place(ways[0].T_a_b)}"]
    parts += [
        f"tags {_names(tuple(tag for tag in way.inliers if tag not in first) or way.inliers)} at {_place(way.T_a_b)}"
        for way in ways[1:3]
    ]
    more = f", and there are {len(ways) - 3} more alternatives" if len(ways) > 3 else ""
    return (
        f"the place of {b} in {a} is ambiguous, because {', '.join(parts)}{more}: it is unknown which tags stayed and "
        "which were moved or relabelled; a few more unmoved shared tags would suffice"
    )


def _names(tags: Sequence[TagKey]) -> str:
    named = ", ".join(f"{tag.tag_id}{tag.instance}" for tag in tags[:_MOST_NAMED])
    return named if len(tags) <= _MOST_NAMED else f"{named} and {len(tags) - _MOST_NAMED} more"


def _place(T: FloatArray) -> str:
    return f"({T[0]:.2f}, {T[1]:.2f}) m turned by {degrees(T[2]):.1f} deg"
