"""Consistency of a map: alignments of local maps, outlier tags, and external measurements; typed, in SI units."""

from dataclasses import dataclass

from groundsbot.calib.foundation import FloatArray


@dataclass(frozen=True)
class AlternativeResult:
    """Alternative transform that explains the shared tags almost as well."""

    T_from_to: FloatArray  # (3,)
    tags: tuple[tuple[str, int], ...]  # (family, tag id) of those that fit it


@dataclass(frozen=True)
class AlignmentResult:
    """Transform between two local maps, from their shared tags."""

    from_run: str
    to_run: str
    T_from_to: FloatArray  # (3,) pose of the second run's start in the first run's frame
    n_shared: int
    n_inliers: int
    inlier_rmse_m: float
    outliers: tuple[tuple[str, int], ...]  # (family, tag id) of shared tags that do not fit
    is_accepted: bool = True  # else it is not used: chance or an alternative explains the tags almost as well
    alternatives: tuple[AlternativeResult, ...] = ()
    is_weak: bool = False  # rests on one tag: if that was moved in between, nothing shows it
    # (3, 3) of T_from_to as x, y, theta in the first run's frame; None if the transform is only an initial value.
    covariance: FloatArray | None = None


@dataclass(frozen=True)
class Misfit:
    """Lack of fit of a component.

    Attributes:
        kind: joins (drives disagree on shared tags or calibration) or windows (windows of one drive disagree).
        run: the one that fits worst.
        chi_square: chi-square in squared sigmas of the noise that the map was made with.
        expected: expected value of `chi_square`.
    """

    kind: str
    run: str
    chi_square: float
    expected: int

    @property
    def variance_factor(self) -> float:
        """Factor on covariances that covers the misfit, at least 1."""
        return max(1.0, self.chi_square / self.expected)


@dataclass(frozen=True)
class OutlierTag:
    """Tag with outlier observations.

    Attributes:
        kind: moved (between runs), moving (during one), swapped, duplicated (two tags with one id), phantom (a false
            detection) or inconsistent (its run has most of its tags elsewhere).
        runs: moved, swapped: those in which it is not at its first place; moving: during which it was moved;
            duplicated: that observed it; phantom: with the false detections; inconsistent: the one that is wrong.
        evidence: as a sentence with numbers.
        swapped_with: the other tag's id.
        has_ordered_places: whether, by the logs' clocks, each of its places (a, b, ...) was observed for the last time
            before the next one was for the first.
    """

    family: str
    tag_id: int
    kind: str
    runs: tuple[str, ...]
    evidence: str
    swapped_with: int | None = None
    has_ordered_places: bool = False

    def line(self) -> str:
        """Return a line for the terminal."""
        return f"tag {self.tag_id} ({self.family}) {self.kind}: {self.evidence}"


@dataclass(frozen=True)
class MeasurementResult:
    """External measurement, and how it agrees with the map."""

    kind: str  # start or distance
    a: str  # the run whose start is the frame, or one end: a run, or family:id of a tag
    b: str  # the run, or the other end
    measured: FloatArray  # (3,) x_m, y_m, theta_rad in map, or (1,) metres
    sigma: FloatArray  # likewise
    component: int | None  # that uses it; None: its ends are in different components, or the map contradicts it
    in_map: FloatArray | None = None  # (3,) or (1,) value in the finished map; unused: in the map made without it
    residual_sigmas: float | None = None  # norm of the whitened residual
    # Deviation from the map without it, in sigmas of the difference; None if the map without it leaves it undetermined.
    off_sigmas: float | None = None
    contradicts: bool = False  # by more than chance allows
