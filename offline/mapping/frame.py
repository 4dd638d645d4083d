"""The frame of a map, as `--frame` names it: a run's start, the tags' own axes, those of two tags, or a survey's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, hypot
from os import fspath
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, StrPath, plural
from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation import SurveyEntry, align_survey, read_survey
from groundsbot.offline.maps import (
    Component,
    CrossCovariances,
    DatumKind,
    TagDatum,
    datum_centre,
    move_to_start,
    move_to_tags,
    tags_own_axes,
)

_START: Final = "start"
_SHAPE: Final = "shape"
# Endings of a survey, and of WPILib's layout of a field.
_SURVEY_ENDINGS: Final = (".csv", ".json")


@dataclass(frozen=True)
class FrameChoice:
    """The frame of each component of a map.

    Attributes:
        datum: what holds it; None: the start of a run.
        run: run whose start is the frame of its component; empty: each component's first run.
        pair: names of the tags at the origin and in the direction of x: an id, or FAMILY:ID.
        survey: entries of the survey.
        text: as it was given.
    """

    datum: DatumKind | None = None
    run: str = ""
    pair: tuple[str, str] | None = None
    survey: tuple[SurveyEntry, ...] = ()
    text: str = _START

    def check_run(self, names: Sequence[str]) -> None:
        """Raise an error if the frame refers to a run that is not in the map.

        Args:
            names: names of the runs in the map.

        Raises:
            OfflineError: there is no such run. The message lists those that there are.
        """
        if self.run and self.run not in names:
            raise OfflineError(
                f"--frame start:{self.run}: the logs hold no run {self.run!r}; use one of {', '.join(names)}"
            )


class FramedComponent(NamedTuple):
    """A component in the chosen frame.

    Attributes:
        component: component in that frame; in that of its first start where it can have no other.
        T_frame_start: (3,) pose of the first start in it; None where it is the frame.
        warnings: warnings about the frame.
        reason: why the component cannot have the chosen frame; empty if it has it.
    """

    component: Component
    T_frame_start: FloatArray | None = None
    warnings: tuple[str, ...] = ()
    reason: str = ""


def parse_frame(text: StrPath) -> FrameChoice:
    """Parse "start", "start:RUN", "shape", "A,B" or the path of a survey, and read the survey.

    "tags" and "survey:FILE", as older commands have them, are "shape" and FILE.

    Raises:
        OfflineError: none of these, or not a survey.
    """
    text = fspath(text)
    kind, _, value = text.partition(":")
    if kind == _START and (value or text == _START):
        return FrameChoice(run=value, text=text)
    if text in (_SHAPE, DatumKind.TAGS):
        return FrameChoice(DatumKind.TAGS, text=text)
    path = Path(value if kind == DatumKind.SURVEY else text)
    if (kind == DatumKind.SURVEY and value) or path.suffix.lower() in _SURVEY_ENDINGS:
        return FrameChoice(DatumKind.SURVEY, survey=tuple(read_survey(path)), text=text)
    first, comma, second = (part.strip() for part in text.partition(","))
    if comma and first and second and "," not in second and first != second:
        return FrameChoice(DatumKind.PAIR, pair=(first, second), text=text)
    raise OfflineError(
        f"--frame {text}: must be start, start:RUN, shape, two tags A,B, or a survey (.csv, or a layout's .json)"
    )


def in_frame(component: Component, choice: FrameChoice, cross: Callable[[], CrossCovariances]) -> FramedComponent:
    """Return a component in a chosen frame.

    Args:
        component: component in the frame of its first run's start.
        choice: choice of the frame.
        cross: returns covariances that the change needs, not yet inflated by the component's lack of fit.
    """
    warnings: tuple[str, ...] = ()
    if choice.datum is None:
        if choice.run == component.frame_run or choice.run not in [run.name for run in component.runs]:
            return FramedComponent(component)
        moved = move_to_start(component, choice.run, _inflate(cross(), component))
    else:
        try:
            datum, T_frame_map, warnings = _tag_frame(component, choice)
        except OfflineError as error:
            return FramedComponent(component, reason=str(error))
        moved = move_to_tags(component, datum, T_frame_map, _inflate(cross(), component))
    return FramedComponent(moved, moved.runs[0].T_map_start, warnings)


def _inflate(cross: CrossCovariances, component: Component) -> CrossCovariances:
    factor = component.sigma_factor**2
    attitudes = None if cross.attitudes is None else factor * cross.attitudes
    return CrossCovariances(factor * cross.calibration_with_starts, attitudes)


def _tag_frame(component: Component, choice: FrameChoice) -> tuple[TagDatum, FloatArray, tuple[str, ...]]:
    """Return the frame that tags hold: its datum, the pose (3,) of the component's frame in it, and warnings.

    Raises:
        OfflineError: the component's tags cannot hold it.
    """
    _check_tags(component)
    if choice.datum is DatumKind.SURVEY:
        return align_survey(component, choice.survey)
    if choice.pair is not None:
        return (*_axes_of_pair(component, choice.pair), ())
    return TagDatum(DatumKind.TAGS, np.ones(len(component.tags))), tags_own_axes(component), ()


def _axes_of_pair(component: Component, names: tuple[str, str]) -> tuple[TagDatum, FloatArray]:
    """Return the frame with its origin at the first tag and x towards the second, which hold it alike.

    Raises:
        OfflineError: one of them is not in the component, or both are in one place.
    """
    a, b = (_index_of_tag(component, name) for name in names)
    origin_m, towards_m = component.tags[a].position_m, component.tags[b].position_m
    x_m, y_m = (towards_m - origin_m).tolist()
    if a == b or hypot(x_m, y_m) == 0.0:
        raise OfflineError(f"tags {names[0]} and {names[1]} are in one place; name two in different places")
    weights = np.zeros(len(component.tags))
    weights[[a, b]] = 1.0
    return TagDatum(DatumKind.PAIR, weights), se2.inverse(np.array([*origin_m, atan2(y_m, x_m)]))


def _index_of_tag(component: Component, name: str) -> int:
    """Return the index of a tag, called by its id and instance, or by its family too.

    Raises:
        OfflineError: there is none, or there are several.
    """
    found = [i for i, tag in enumerate(component.tags) if name in (tag.label, tag.full_label)]
    if len(found) == 1:
        return found[0]
    same_id = [tag.full_label for tag in component.tags if name in (str(tag.tag_id), tag.label)]
    if same_id:
        raise OfflineError(f"the map has tag {name} in several places; name one of {', '.join(same_id)}")
    raise OfflineError(f"the map has no tag {name}; name one of {', '.join(tag.label for tag in component.tags)}")


def _check_tags(component: Component) -> None:
    """Raise an error if the tags cannot define a frame.

    Raises:
        OfflineError: there are fewer than two tags at different positions, or covariances are unknown.
    """
    places_m = np.array([tag.position_m for tag in component.tags]).reshape(-1, 2)
    if datum_centre(places_m, np.ones(len(places_m))) is None:
        raise OfflineError(
            f"the map has {plural(len(places_m), 'tag')}, at least two in different places are needed; drive past "
            "more, or leave --frame out"
        )
    if not np.isfinite(component.joint_covariance).all():
        raise OfflineError("the covariances of the tags are unknown, as warnings say; leave --frame out")
