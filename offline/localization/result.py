"""What localising hands out: the trajectory of a run in a map that stays as it is, and what of the map no longer holds.

Typed, in the frame of the map's component, in SI units.
"""

from dataclasses import dataclass
from pathlib import Path

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.measurements import TagKey


@dataclass(frozen=True)
class LocatedRun:
    """One segment of unbroken odometry in the map.

    Attributes:
        name: as in `RunResult`; run: that it belongs to.
        stamps_ns: (K,)
        T_map_base: (K, 3) x_m, y_m, theta_rad.
        covariance: (K, 3, 3) map frame, (x, y, theta): m^2, m rad, rad^2; the map's own uncertainty included.
        tags: of the map that hold it.
        distance_m: by the wheels.
    """

    name: str
    run: str
    stamps_ns: IntArray
    T_map_base: FloatArray
    covariance: FloatArray
    tags: tuple[TagKey, ...]
    distance_m: float


@dataclass(frozen=True)
class Candidate:
    """A place where a segment may have started."""

    component: int
    T_map_start: FloatArray  # (3,)
    tags: tuple[TagKey, ...]  # of the map that say so


@dataclass(frozen=True)
class NotLocated:
    """A segment whose place in the map is not known.

    Attributes:
        reason: a sentence.
        candidates: places that explain its tags alike, where there are several; else none.
    """

    name: str
    reason: str
    candidates: tuple[Candidate, ...] = ()


@dataclass(frozen=True)
class MovedTag:
    """A tag that no longer hangs where the map has it; its place there is not used."""

    tag: TagKey
    run: str  # the segment that saw it elsewhere
    position_m: FloatArray  # (2,) where it hangs now
    shift_m: float  # from where the map and the run put it
    sigmas: float

    def line(self) -> str:
        """For a terminal."""
        name = f"{self.tag.tag_id}{self.tag.instance} ({self.tag.family})"
        return (
            f"tag {name} moved: {self.run} has it {self.shift_m:.2f} m ({self.sigmas:.0f} sigma) from where the map "
            f"does, at x {self.position_m[0]:.2f} m, y {self.position_m[1]:.2f} m"
        )


@dataclass(frozen=True)
class Localization:
    """One run in one component of a map.

    Attributes:
        map: the map's folder.
        frame_run: whose start is the frame; component: its index.
        runs: the segments that were located.
        not_located: those that were not.
        moved: tags that hang elsewhere now.
        new: tags that the map does not have.
        warnings: what a person should know; losses: what of the log cannot be read.
    """

    map: Path
    frame_run: str
    component: int
    runs: tuple[LocatedRun, ...]
    not_located: tuple[NotLocated, ...] = ()
    moved: tuple[MovedTag, ...] = ()
    new: tuple[TagKey, ...] = ()
    warnings: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()

    @property
    def is_located(self) -> bool:
        """Whether any segment is."""
        return bool(self.runs)
