"""How large and how accurate a map is, as figures and in words, from the document that map.json is written from."""

from collections.abc import Sequence
from math import degrees
from typing import Any, Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import plural
from groundsbot.calib.robot import IMPORTED_BATCH, TAG_SCALE
from groundsbot.offline.maps import DatumKind
from groundsbot.offline.report.cells import UNKNOWN, has_several_families, length_text, percent_text, tag_label

# Figures and headline name so many components.
_MOST_COMPONENTS: Final = 3
# Of a map that is smaller than this in one direction, the size is given with a decimal.
_WHOLE_METRES: Final = 9.5
_SCALE_SOURCES: Final = {
    "wheels": "the wheels' radii",
    "track": "the distance between the wheels",
    "tags": "the size of the tags",
    "mount": "the position of the camera",
    "distances": "distances measured by hand",
    "starts": "starts measured by hand",
}
# Of imported runs, whose logs hold lengths instead of turns of wheels and corners of tags.
_IMPORTED_SCALE_SOURCES: Final = {
    "wheels": "the scale of the imported odometry",
    "tags": "the scale of the imported ranges (of a range sensor, or by the tag size of a detector)",
}


class KeyFigure(NamedTuple):
    """One of the figures on top of the report."""

    name: str
    value: str
    note: str


def key_figures(document: dict[str, Any]) -> list[KeyFigure]:
    """Return how large the map is, how accurate its shape and how accurate its scale, by component."""
    by_component = _tags_by_component(document)
    n, n_tags = len(document["components"]), len(document["tags"])
    names = [f"component {i + 1}: " if n > 1 else "" for i in range(n)]
    among = _join_largest(
        [
            f"{name}{plural(len(tags), 'tag')} {_size_text(tags)}" if n > 1 else _size_text(tags)
            for name, tags in zip(names, by_component, strict=True)
        ],
        "; ",
    )
    n_again = n_tags - len({(tag["family"], tag["tag_id"], tag["component"]) for tag in document["tags"]})
    if n_again:
        among += f"; {n_again} of them further places of suspect tags"
    shapes = [
        (name, shape) for name, tags in zip(names, by_component, strict=True) if (shape := _shape_of(document, tags))
    ]
    medians, told = UNKNOWN, "unknown with fewer than two tags"
    if shapes:
        medians = _join_largest([shape.median for _, shape in shapes], " · ")
        worst = _join_largest([f"{name}tag {shape.worst_tag}, {shape.worst}" for name, shape in shapes], "; ")
        told = f"sigma of a typical tag relative to the others, the scale's error included; of the worst, {worst}"
    scale, source = scale_texts(document)
    return [
        KeyFigure(plural(n_tags, "tag").partition(" ")[2], str(n_tags), among),
        KeyFigure("shape", medians, told),
        KeyFigure("scale", scale, f"sigma of all lengths, {source}" if source else "nothing determines it"),
    ]


class _Shape(NamedTuple):
    """Sigmas of a component's tags relative to each other, as texts."""

    median: str
    worst_tag: str
    worst: str


def _shape_of(document: dict[str, Any], tags: Sequence[dict[str, Any]]) -> _Shape | None:
    """Return how accurate the shape of a component with these tags is; None with fewer than two."""
    known = [tag for tag in tags if tag["shape_sigma_m"] is not None]
    if not known:
        return None
    worst = max(known, key=lambda tag: float(tag["shape_sigma_m"]))
    label = tag_label(worst, several_families=has_several_families(document))
    median_m = float(np.median([tag["shape_sigma_m"] for tag in known]))
    return _Shape(length_text(median_m), label, length_text(worst["shape_sigma_m"]))


def _size_text(tags: Sequence[dict[str, Any]]) -> str:
    if not tags:
        return UNKNOWN
    wide_m, high_m = np.ptp(np.array([tag["position_m"][:2] for tag in tags]), axis=0)
    digits = 0 if min(wide_m, high_m) >= _WHOLE_METRES else 1
    return f"over {wide_m:.{digits}f} m x {high_m:.{digits}f} m"


def _tags_by_component(document: dict[str, Any]) -> list[list[dict[str, Any]]]:
    return [
        [tag for tag in document["tags"] if tag["component"] == index] for index in range(len(document["components"]))
    ]


def _join_largest(texts: Sequence[str], separator: str) -> str:
    """Return the texts of the largest components."""
    more = [f"{len(texts) - _MOST_COMPONENTS} more"] if len(texts) > _MOST_COMPONENTS else []
    return separator.join([*texts[:_MOST_COMPONENTS], *more])


def scale_texts(document: dict[str, Any]) -> tuple[str, str]:
    """Return the sigma of the scale, and what most of it comes from."""
    if not document["metres"] or document["metres"][0]["sigma"] is None:
        return UNKNOWN, ""
    metre = document["metres"][0]
    kind, share = max(metre["shares"].items(), key=lambda each: each[1], default=("", 0.0))
    if not kind:
        return percent_text(metre["sigma"]), ""
    owners = [each["owner"] for each in document["calibration"] if each["name"] == TAG_SCALE]
    is_imported = bool(owners) and all(owner.startswith(IMPORTED_BATCH) for owner in owners)
    named = _SCALE_SOURCES | (_IMPORTED_SCALE_SOURCES if is_imported else {})
    return percent_text(metre["sigma"]), f"{100.0 * share:.0f} % of that from {named[kind]}"


def headline(document: dict[str, Any]) -> str:
    """Return how accurate the map is, its shape first."""
    if all(tag["sigma_m"] is None for tag in document["tags"]):
        return "It has no tags, so nothing corrects the wheels' odometry."
    told = _accuracy_sentences(document)
    pairs = document["start_to_start"]
    if len(pairs) == 1:
        pair = pairs[0]
        told += (
            f" From the start of {pair['a']} to that of {pair['b']} it is {pair['distance_m']:.2f} m, sigma "
            f"{length_text(pair['sigma_m'])}."
        )
    return told


def _accuracy_sentences(document: dict[str, Any]) -> str:
    """Return how accurate tags are relative to each other, and with one component relative to its frame."""
    by_component = _tags_by_component(document)
    shapes = {
        i: shape for i, tags in enumerate(by_component, start=1) if (shape := _shape_of(document, tags)) is not None
    }
    if len(by_component) > 1 and shapes:
        (first, shape), *others = shapes.items()
        told = f"In component {first} tags are known to {shape.median} relative to each other (median, one sigma; the "
        told += f"worst, tag {shape.worst_tag}, to {shape.worst})"
        for i, each in others[: _MOST_COMPONENTS - 1]:
            told += f", in component {i} to {each.median} (tag {each.worst_tag} to {each.worst})"
        n_more = len(shapes) - _MOST_COMPONENTS
        return f"{told}; {plural(n_more, 'component')} more." if n_more > 0 else f"{told}."
    known = [tag for tag in document["tags"] if tag["sigma_m"] is not None]
    tags, component = by_component[known[0]["component"]], document["components"][known[0]["component"]]
    seen_from_frame = length_text(float(np.median([tag["sigma_m"] for tag in tags if tag["sigma_m"] is not None])))
    shape = _shape_of(document, tags)
    if shape is None or component["heading_sigma_rad"] is None:
        return (
            f"Tags are known to {seen_from_frame} (median, one sigma), relative to the start of "
            f"{component['frame_run']}."
        )
    return (
        f"Tags are known to {shape.median} relative to each other (median, one sigma; the worst, tag "
        f"{shape.worst_tag}, to {shape.worst}). {_frame_sentence(component, seen_from_frame)}"
    )


def _frame_sentence(component: dict[str, Any], length: str) -> str:
    """Return which frame sigmas refer to, and how accurate tags are in it."""
    datum = component.get("datum")
    if datum is None:
        return (
            f"Relative to the start of {component['frame_run']}, whose heading is uncertain by "
            f"{degrees(component['heading_sigma_rad']):.1f} degrees, they are known to {length}."
        )
    if datum["kind"] == DatumKind.TAGS:
        return "All sigmas refer to the tags' own axes, so shift and turn of all tags together are not in them."
    if datum["kind"] == DatumKind.PAIR:
        return f"Relative to {frame_name(component)}, they are known to {length}."
    held_by = plural(sum(weight > 0.0 for weight in datum["weights"]), "surveyed tag")
    return (
        f"Relative to the survey's frame, they are known to {length}; all sigmas refer to that frame as {held_by} "
        "hold it, without the survey's own errors."
    )


def frame_name(component: dict[str, Any]) -> str:
    """Return what the sigmas of a component, an entry of `components`, refer to."""
    datum = component.get("datum")
    if datum is None:
        return f"the start of {component['frame_run']}"
    held_by = [tag for tag, weight in zip(component["tags"], datum["weights"], strict=True) if weight > 0.0]
    return DatumKind(datum["kind"]).frame_name([tag_label(tag, several_families=False) for tag in held_by])
