"""What the covariances of a component refer to, where that is not a run's start."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from groundsbot.calib.foundation import FloatArray


class DatumKind(StrEnum):
    """Where the axes of a frame that tags hold come from."""

    TAGS = "tags"
    PAIR = "pair"
    SURVEY = "survey"

    def owner(self, held_by: Sequence[str]) -> str:
        """Return what a frame of this kind is of, for sentences, given the labels of the tags that hold it."""
        return f"tags {' and '.join(held_by)}" if self is DatumKind.PAIR else f"the {self}"

    def frame_name(self, held_by: Sequence[str]) -> str:
        """Return the frame, for sentences, given the labels of the tags that hold it."""
        if self is DatumKind.PAIR:
            return f"the axes of {self.owner(held_by)}"
        return "the tags' own axes" if self is DatumKind.TAGS else "the survey's frame"


@dataclass(frozen=True)
class SurveyedTag:
    """A place by the survey that is a component's frame.

    Attributes:
        tag_id: id of the tag.
        instance: instance as in the map's tags; empty where the id is in one place.
        position_m: (2,) in the survey's frame.
        tag: index of the component's tag; None where the component does not have it.
    """

    tag_id: int
    instance: str
    position_m: FloatArray
    tag: int | None


@dataclass(frozen=True)
class TagDatum:
    """A frame that tags hold: the weighted mean shift and rotation of their errors is zero in it.

    Attributes:
        kind: the tags' own axes, those of two tags, or a survey's.
        weights: (T,) of the component's tags, 0 for those that do not hold it.
        survey: the survey's places; none of another kind.
    """

    kind: DatumKind
    weights: FloatArray
    survey: tuple[SurveyedTag, ...] = ()


def datum_centre(places_m: FloatArray, weights: FloatArray) -> FloatArray | None:
    """Return the weighted mean (2,) of positions (T, 2); None if they determine no rotation about it."""
    if not weights.sum() > 0.0:
        return None
    centre = np.asarray(weights @ places_m / weights.sum())
    return centre if weights @ ((places_m - centre) ** 2).sum(axis=1) > 0.0 else None
