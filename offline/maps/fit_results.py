"""What fits together in a map and what does not: local maps, tags, and what somebody measured; typed, in SI units."""

from dataclasses import dataclass

from groundsbot.calib.foundation import FloatArray


@dataclass(frozen=True)
class AlternativeResult:
    """Another transform that explains the shared tags almost as well."""

    T_from_to: FloatArray  # (3,)
    tags: tuple[tuple[str, int], ...]  # (family, tag id) of those that fit it


@dataclass(frozen=True)
class AlignmentResult:
    """Transform between two local maps, from the tags they share."""

    from_run: str
    to_run: str
    T_from_to: FloatArray  # (3,) pose of the second run's start in the first run's frame
    n_shared: int
    n_inliers: int
    inlier_rmse_m: float
    outliers: tuple[tuple[str, int], ...]  # (family, tag id) of shared tags that do not fit
    is_sure: bool = True  # else the runs are not joined by it: chance or a rival explains the tags almost as well
    rivals: tuple[AlternativeResult, ...] = ()
    is_weak: bool = False  # one tag alone joins them: if that was moved in between, nothing shows it
    # (3, 3) of T_from_to as x, y, theta in the first run's frame; None where the transform only begins a solve.
    covariance: FloatArray | None = None


@dataclass(frozen=True)
class Misfit:
    """What of a component the model does not explain.

    Attributes:
        kind: joins (drives do not share tags and calibration as they should) or windows (parts of drives do not join).
        run: what fits worst.
        chi_square: in squared sigmas of the noise that the map was made with.
        expected: how much of it chance explains.
    """

    kind: str
    run: str
    chi_square: float
    expected: int

    @property
    def variance_factor(self) -> float:
        """By how many times covariances must grow to cover it, 1 at least."""
        return max(1.0, self.chi_square / self.expected)


@dataclass(frozen=True)
class SuspectTag:
    """A tag that does not belong.

    Attributes:
        kind: moved (between runs), moving (during one), swapped, duplicated (two tags with one id), phantom (a false
            detection) or inconsistent (its run has most of its tags elsewhere).
        runs: moved, swapped: in which it is not where it was first; moving: during which it was moved; duplicated:
            that saw it; phantom: with the false detections; inconsistent: the one that is wrong.
        evidence: in words, with numbers.
        swapped_with: the other tag's id.
    """

    family: str
    tag_id: int
    kind: str
    runs: tuple[str, ...]
    evidence: str
    swapped_with: int | None = None

    def line(self) -> str:
        """For a terminal."""
        return f"tag {self.tag_id} ({self.family}) {self.kind}: {self.evidence}"


@dataclass(frozen=True)
class MeasurementResult:
    """What a person measured, and what the map makes of it."""

    kind: str  # start or distance
    a: str  # the run whose start is the frame, or one end: a run, or family:id of a tag
    b: str  # the run, or the other end
    measured: FloatArray  # (3,) x_m, y_m, theta_rad in map, or (1,) metres
    sigma: FloatArray  # likewise
    component: int | None  # in which it was used; None: its ends are in different components
    in_map: FloatArray | None = None  # (3,) or (1,) as the map has it in the end
    residual_sigmas: float | None = None  # length of what is left over, whitened
    # How far it lies from what all else says, in sigmas of the difference; None where nothing else says anything.
    off_sigmas: float | None = None
    contradicts: bool = False  # by more than chance allows
