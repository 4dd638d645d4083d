"""Errors between a survey and a map, as figures and lines."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.evaluation.survey_file import SurveyEntry
from groundsbot.offline.maps import Component, TagResult

_ASSUMED: Final = (
    "the survey gives no sigmas: {:g} m is assumed for each coordinate, and NEES and wrong entries depend on it (a CSV "
    "file can give sigma_m)"
)


@dataclass(frozen=True)
class EntryResult:
    """One entry against the map.

    Attributes:
        tag: tag of the map.
        entry: entry of the survey, which refers to this tag.
        shift_m: shift from the entry to the position by the map and the other entries, in map axes (2,).
        sigmas: Mahalanobis length of that shift.
        verdict: "fits", "wrong" or "swapped".
        swapped_with: the other tag of a pair that fits once exchanged.
    """

    tag: TagResult
    entry: SurveyEntry
    shift_m: FloatArray
    sigmas: float
    verdict: str
    swapped_with: int | None = None

    def line(self) -> str:
        """Return a line for the user about an entry that does not fit."""
        name = f"{self.tag.family} {self.tag.label}"
        off = f"{float(np.linalg.norm(self.shift_m)):.3f} m ({self.sigmas:.0f} sigmas)"
        if self.verdict == "swapped":
            return f"entry {name} looks swapped with {self.swapped_with}: it fits there, and deviates by {off} here"
        return f"entry {name} looks wrong: by the map and the other entries, the tag is {off} away from it"


@dataclass(frozen=True)
class ComponentSurvey:
    """One component against the survey; figures are of the entries that fit.

    Attributes:
        component: component of the map.
        rmse_m, worst_m: after unweighted least squares.
        T_map_survey: (3,) pose of the survey's frame in the map.
        scale_error: relative excess of the map's distances over the survey's, with its sigma.
        nees_per_dim: NEES per dimension of the residuals of the alignment; None without redundancy.
    """

    component: Component
    entries: tuple[EntryResult, ...]
    T_map_survey: FloatArray
    rmse_m: float
    worst_m: float
    scale_error: float
    scale_sigma: float
    nees_per_dim: float | None

    @property
    def outliers(self) -> tuple[EntryResult, ...]:
        """Entries that look wrong."""
        return tuple(entry for entry in self.entries if entry.verdict != "fits")

    def as_json(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "frame_run": self.component.frame_run,
            "n_entries": len(self.entries),
            "T_map_survey": self.T_map_survey.tolist(),
            "tags_rmse_aligned_m": self.rmse_m,
            "worst_m": self.worst_m,
            "scale_error": self.scale_error,
            "scale_sigma": self.scale_sigma,
            "nees_per_dim": self.nees_per_dim,
            "entries": [
                {
                    "family": entry.tag.family,
                    "tag_id": entry.tag.tag_id,
                    "instance": entry.tag.instance,
                    "shift_m": entry.shift_m.tolist(),
                    "sigmas": entry.sigmas,
                    "verdict": entry.verdict,
                    "swapped_with": entry.swapped_with,
                }
                for entry in self.entries
            ],
        }

    def lines(self) -> list[str]:
        """Return the errors and the entries that look wrong, as lines of text."""
        n_good = len(self.entries) - len(self.outliers)
        nees = "no redundancy" if self.nees_per_dim is None else f"{self.nees_per_dim:.2f}"
        lines = [
            f"frame: {self.component.frame_name.removeprefix('the ')}; {len(self.entries)} surveyed tags, {n_good} fit",
            f"  aligned, those that fit: RMSE {self.rmse_m:.3f} m, worst {self.worst_m:.3f} m",
            f"  scale: {100.0 * self.scale_error:+.2f} % against the survey (sigma {100.0 * self.scale_sigma:.2f} %)",
            f"  NEES per dimension (1 is consistent): {nees}",
        ]
        return lines + [f"  {entry.line()}" for entry in self.outliers]


@dataclass(frozen=True)
class SurveyErrors:
    """A whole map against the survey.

    Attributes:
        components: those that share three entries or more.
        not_in_map: entries that refer to no tag of the map.
    """

    components: tuple[ComponentSurvey, ...]
    not_in_map: tuple[SurveyEntry, ...]

    def __repr__(self) -> str:
        return f"<SurveyErrors: {self.lines()[0]}>"

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines about the whole."""
        ids = ", ".join(str(entry.tag_id) for entry in self.not_in_map)
        entries = [each.entry for component in self.components for each in component.entries]
        assumed_m = next((entry.sigma_m for entry in entries if entry.is_sigma_assumed), None)
        return (
            *([f"not in the map: tags {ids}"] if ids else []),
            *([] if assumed_m is None else [_ASSUMED.format(assumed_m)]),
        )

    def as_json(self) -> dict[str, Any]:
        """Return plain data; the largest component's figures at the top."""
        parts = [component.as_json() for component in self.components]
        return parts[0] | {"components": parts, "notes": list(self.notes)}

    def lines(self) -> list[str]:
        """Return the errors of all components as lines of text."""
        return [line for component in self.components for line in component.lines()] + list(self.notes)
