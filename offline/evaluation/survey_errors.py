"""What a survey and a map say of each other, in figures and in words."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.maps import TagResult


@dataclass(frozen=True)
class JudgedEntry:
    """One entry against the map.

    Attributes:
        shift_m: from where the entry puts the tag to where the map and the other entries put it, in map axes (2,).
        sigmas: length of that shift in its own sigmas.
        verdict: "fits", "wrong" or "swapped".
        swapped_with: the other tag of a pair that fits once exchanged.
    """

    tag: TagResult
    shift_m: FloatArray
    sigmas: float
    verdict: str
    swapped_with: int | None = None

    def line(self) -> str:
        """For a person; of entries that do not fit."""
        name = f"{self.tag.family} {self.tag.label}"
        off = f"{float(np.linalg.norm(self.shift_m)):.3f} m ({self.sigmas:.0f} sigmas)"
        if self.verdict == "swapped":
            return f"entry {name} looks swapped with {self.swapped_with}: it fits there, and is off by {off} here"
        return f"entry {name} looks wrong: the map and the other entries put the tag {off} away from it"


@dataclass(frozen=True)
class ComponentSurvey:
    """One component against the survey; figures are of the entries that fit.

    Attributes:
        rmse_m, worst_m: after plain least squares, which weighs all alike.
        T_map_survey: (3,) how the survey lies in the map.
        scale_error: by what share the map's distances are longer than the survey's, with its sigma.
        nees_per_dim: of what the alignment leaves over; None where there is nothing over.
    """

    frame_run: str
    entries: tuple[JudgedEntry, ...]
    T_map_survey: FloatArray
    rmse_m: float
    worst_m: float
    scale_error: float
    scale_sigma: float
    nees_per_dim: float | None

    @property
    def odd(self) -> tuple[JudgedEntry, ...]:
        """Entries that look wrong."""
        return tuple(entry for entry in self.entries if entry.verdict != "fits")

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "frame_run": self.frame_run,
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
        """For a person."""
        n_good = len(self.entries) - len(self.odd)
        nees = "nothing left over to judge by" if self.nees_per_dim is None else f"{self.nees_per_dim:.2f}"
        lines = [
            f"frame: start of {self.frame_run}; {len(self.entries)} surveyed tags, {n_good} fit",
            f"  aligned, those that fit: RMSE {self.rmse_m:.3f} m, worst {self.worst_m:.3f} m",
            f"  scale: {100.0 * self.scale_error:+.2f} % against the survey (sigma {100.0 * self.scale_sigma:.2f} %)",
            f"  NEES per dimension (1 is honest): {nees}",
        ]
        return lines + [f"  {entry.line()}" for entry in self.odd]


@dataclass(frozen=True)
class SurveyErrors:
    """A whole map against the survey."""

    components: tuple[ComponentSurvey, ...]
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain data; the largest component's figures on top."""
        parts = [component.as_json() for component in self.components]
        return parts[0] | {"components": parts, "notes": list(self.notes)}

    def lines(self) -> list[str]:
        """For a person."""
        return [line for component in self.components for line in component.lines()] + list(self.notes)
