"""Options of `export`; imports nothing heavy, since the help shows them."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from groundsbot.offline.errors import OfflineError


class ExportFormat(StrEnum):
    """Formats that `export` writes."""

    G2O = "g2o"
    TUM = "tum"
    CSV = "csv"
    GEOJSON = "geojson"
    FRC = "frc"
    LIMELIGHT = "limelight"
    FOXGLOVE = "foxglove"
    RERUN = "rerun"


class LayoutForm(StrEnum):
    """Forms of WPILib's layouts, by the key of their tags."""

    TAGS = "tags"
    FIELD_TAGS = "field-tags"


LAYOUTS: Final = (ExportFormat.FRC, ExportFormat.LIMELIGHT)
_ONLY_FOR: Final = {
    "origin": (ExportFormat.GEOJSON,),
    "tag_poses": LAYOUTS,
    "tag_height_m": LAYOUTS,
    "face_viewers": LAYOUTS,
    "field_m": (ExportFormat.FRC,),
    "family": (ExportFormat.FRC,),
    "layout_form": (ExportFormat.FRC,),
    "frame": tuple(form for form in ExportFormat if form is not ExportFormat.FOXGLOVE),
}


@dataclass(frozen=True)
class ExportOptions:
    """Options of the command line."""

    form: ExportFormat
    output: Path
    component: int | None = None  # index
    origin: str | None = None
    tag_poses: Path | None = None
    tag_height_m: float | None = None
    face_viewers: bool = False
    field_m: str | None = None
    family: str | None = None
    layout_form: LayoutForm | None = None
    frame: str | None = None

    def check(self) -> None:
        """Raise an error if an option was given that has no effect on the chosen format.

        Raises:
            OfflineError: the first such option, and the formats that use it.
        """
        for name, forms in _ONLY_FOR.items():
            if getattr(self, name) not in (None, False) and self.form not in forms:
                raise OfflineError(
                    f"--{name.replace('_', '-')}: is not used by --format {self.form} (only by {', '.join(forms)}); "
                    "leave the option out"
                )


def numbers(option: str, text: str, names: str) -> list[float]:
    """Return the finite numbers of an option such as `--field-m 16.5,8.2`, as many as there are names.

    Raises:
        OfflineError: a part is not a finite number, or their number is wrong.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(names.split(",")) or not all(abs(value) < 1e9 for value in values):
        raise OfflineError(f"{option} {text}: must be {names}, numbers separated by commas")
    return values
