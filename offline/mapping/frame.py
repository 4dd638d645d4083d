"""The frame of a map, as `--frame` names it: a run's start, the tags' own axes, or that of a survey."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, plural
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


@dataclass(frozen=True)
class FrameChoice:
    """The frame of each component of a map.

    Attributes:
        datum: what holds it; None: the start of a run.
        run: whose start is the frame of its component; empty: each component's first run.
        survey: entries of the survey.
    """

    datum: DatumKind | None = None
    run: str = ""
    survey: tuple[SurveyEntry, ...] = ()

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
        component: in that frame; in that of its first start where it can have no other.
        T_frame_start: (3,) pose of the first start in it; None where it is the frame.
        warnings: about the frame.
        reason: why the component cannot have the chosen frame; empty if it has it.
    """

    component: Component
    T_frame_start: FloatArray | None = None
    warnings: tuple[str, ...] = ()
    reason: str = ""


def parse_frame(text: str) -> FrameChoice:
    """Parse `start`, `start:RUN`, `tags` or `survey:FILE`, and read the survey.

    Raises:
        OfflineError: none of these, or not a survey.
    """
    kind, _, value = text.partition(":")
    if kind == _START and (value or text == _START):
        return FrameChoice(run=value)
    if text == DatumKind.TAGS:
        return FrameChoice(DatumKind.TAGS)
    if kind == DatumKind.SURVEY and value:
        return FrameChoice(DatumKind.SURVEY, survey=tuple(read_survey(Path(value))))
    raise OfflineError(f"--frame {text}: must be start, start:RUN, tags or survey:FILE")


def in_frame(component: Component, choice: FrameChoice, cross: Callable[[], CrossCovariances]) -> FramedComponent:
    """Return a component in a chosen frame.

    Args:
        component: in the frame of its first run's start.
        choice: of the frame.
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
    return TagDatum(DatumKind.TAGS, np.ones(len(component.tags))), tags_own_axes(component), ()


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
