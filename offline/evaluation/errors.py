"""Errors of a map against the truth, as figures and lines."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class StartError:
    """Error of the vector from the start of run `a` to the start of run `b`."""

    a: str
    b: str
    distance_m: float
    true_distance_m: float
    vector_error_m: float

    @property
    def distance_error_m(self) -> float:
        """Absolute error of the distance."""
        return abs(self.distance_m - self.true_distance_m)

    @property
    def percent(self) -> float | None:
        """Error of the distance in percent of the true distance; None if that is zero."""
        return 100.0 * self.distance_error_m / self.true_distance_m if self.true_distance_m > 1e-9 else None


@dataclass(frozen=True)
class TagError:
    """Position error of one tag in the frame of its component."""

    family: str
    tag_id: int
    instance: str
    error_m: float
    sigma_m: float  # predicted for the error's length: square root of the covariance's trace


@dataclass(frozen=True)
class ComponentErrors:
    """Figures of one component. None: nothing to compare (one run, no tag, no truth)."""

    frame_run: str | None
    frame_name: str
    runs: tuple[str, ...]
    n_tags: int
    starts: tuple[StartError, ...]
    tags: tuple[TagError, ...]
    tags_rmse_m: float | None
    tags_rmse_aligned_m: float | None
    trajectory_rmse_m: float | None
    nees_tags_per_dim: float | None
    nees_start_per_dim: float | None
    notes: tuple[str, ...]

    @property
    def worst_start(self) -> StartError | None:
        """Pair of starts with the largest vector error."""
        return max(self.starts, key=lambda pair: pair.vector_error_m, default=None)

    def as_json(self) -> dict[str, Any]:
        """Return plain data; the start figures are those of the worst pair, `starts` has all pairs."""
        worst = self.worst_start
        starts = [
            asdict(pair) | {"distance_error_m": pair.distance_error_m, "percent": pair.percent} for pair in self.starts
        ]
        return {
            "frame_run": self.frame_run,
            "runs": list(self.runs),
            "n_tags": self.n_tags,
            "start_to_start_vector_error_m": worst.vector_error_m if worst else None,
            "start_to_start_distance_error_m": worst.distance_error_m if worst else None,
            "start_to_start_percent": worst.percent if worst else None,
            "tags_rmse_m": self.tags_rmse_m,
            "tags_rmse_aligned_m": self.tags_rmse_aligned_m,
            "trajectory_rmse_m": self.trajectory_rmse_m,
            "nees_tags_per_dim": self.nees_tags_per_dim,
            "nees_start_per_dim": self.nees_start_per_dim,
            "starts": starts,
            "tags": [asdict(tag) for tag in self.tags],
            "notes": list(self.notes),
        }

    def lines(self) -> list[str]:
        """Return the errors as lines of text."""
        lines = [f"frame: {self.frame_name.removeprefix('the ')}; runs {', '.join(self.runs)}; {self.n_tags} tags"]
        for pair in self.starts:
            percent = "" if pair.percent is None else f" ({pair.percent:.2f} %)"
            lines.append(
                f"  start of {pair.a} to start of {pair.b}: {pair.distance_m:.3f} m found, "
                f"{pair.true_distance_m:.3f} m true, off by {pair.distance_error_m:.3f} m{percent}; "
                f"vector off by {pair.vector_error_m:.3f} m"
            )
        for what, value, unit in (
            ("tags RMSE, without alignment", self.tags_rmse_m, " m"),
            ("tags RMSE, aligned", self.tags_rmse_aligned_m, " m"),
            ("trajectory RMSE, without alignment", self.trajectory_rmse_m, " m"),
            ("tags NEES per dimension (1 is consistent)", self.nees_tags_per_dim, ""),
            ("start NEES per dimension (1 is consistent)", self.nees_start_per_dim, ""),
        ):
            lines.append(f"  {what}: {'nothing to compare' if value is None else f'{value:.3f}{unit}'}")
        worst = max(self.tags, key=lambda tag: tag.error_m, default=None)
        if worst is not None:
            name = f"{worst.family} {worst.tag_id}{worst.instance}"
            lines.append(f"  worst tag: {name}, off by {worst.error_m:.3f} m (sigma {worst.sigma_m:.3f} m)")
        return lines + [f"  {note}" for note in self.notes]


@dataclass(frozen=True)
class MapErrors:
    """Figures of a whole map: each component in its own frame, largest first."""

    components: tuple[ComponentErrors, ...]

    def __repr__(self) -> str:
        return f"<MapErrors: {self.lines()[0]}>"

    def lines(self) -> list[str]:
        """Return the errors of all components as lines of text."""
        lines = [line for component in self.components for line in component.lines()]
        if len(self.components) > 1:
            lines.insert(0, f"{len(self.components)} components, each evaluated in its own frame, largest first")
        return lines

    def as_json(self) -> dict[str, Any]:
        """Return the largest component's figures at the top, and each component's in `components`."""
        parts = [component.as_json() for component in self.components]
        return parts[0] | {"components": parts}
