"""The result of localization: the trajectory of a run in a map, and tags that moved since the map was made.

All values are in SI units and in the frame of the map's component.
"""

from dataclasses import dataclass
from pathlib import Path

from groundsbot.calib.foundation import FloatArray, IntArray, plural
from groundsbot.offline.measurements import TagKey


@dataclass(frozen=True)
class LocatedRun:
    """The trajectory of one segment of unbroken odometry in the map.

    Attributes:
        name: name as in `RunResult`; run: run that it belongs to.
        stamps_ns: (K,)
        T_map_base: (K, 3) x_m, y_m, theta_rad.
        covariance: (K, 3, 3) in the map frame, of (x, y, theta): m^2, m rad, rad^2; includes the map's uncertainty.
        tags: tags of the map that constrain it.
        distance_m: driven, by the wheels.
    """

    name: str
    run: str
    stamps_ns: IntArray
    T_map_base: FloatArray
    covariance: FloatArray
    tags: tuple[TagKey, ...]
    distance_m: float

    def __repr__(self) -> str:
        keyframes, tags = plural(len(self.stamps_ns), "keyframe"), plural(len(self.tags), "tag")
        return f"<LocatedRun {self.name}: {keyframes}, {self.distance_m:.1f} m, by {tags}>"


@dataclass(frozen=True)
class Candidate:
    """A pose where a segment may have started.

    Attributes:
        component: component of the map.
        T_map_start: (3,) x_m, y_m, theta_rad.
        tags: tags of the map that support it.
    """

    component: int
    T_map_start: FloatArray
    tags: tuple[TagKey, ...]


@dataclass(frozen=True)
class NotLocated:
    """A segment whose pose in the map is not known.

    Attributes:
        name: name of the segment.
        reason: why, for the user.
        candidates: alternative poses that explain its tags equally well; empty where there are none.
    """

    name: str
    reason: str
    candidates: tuple[Candidate, ...] = ()


@dataclass(frozen=True)
class MovedTag:
    """A tag that moved since the map was made; its position in the map is not used.

    Attributes:
        tag: tag of the map.
        run: the segment that observed it at another position.
        position_m: (2,) its present position.
        shift_m: distance from the position predicted from the map and the run.
        sigmas: the same in sigmas.
    """

    tag: TagKey
    run: str
    position_m: FloatArray
    shift_m: float
    sigmas: float

    def line(self) -> str:
        """Return a line for the terminal."""
        name = f"{self.tag.tag_id}{self.tag.instance} ({self.tag.family})"
        return (
            f"tag {name} moved: {self.run} observed it {self.shift_m:.2f} m ({self.sigmas:.0f} sigma) from its "
            f"position in the map, at x {self.position_m[0]:.2f} m, y {self.position_m[1]:.2f} m"
        )


@dataclass(frozen=True)
class Localization:
    """One run in one component of a map.

    Attributes:
        map: the map's folder.
        frame_run: the run whose start is the frame; None where tags hold it.
        component: its index.
        runs: the segments that were located.
        not_located: those that were not.
        moved: tags that moved since the map was made.
        new: tags that are not in the map.
        warnings: messages for the user; losses: what cannot be read of the log.
        converged: the solve; if not, the trajectory is not to be used.
    """

    map: Path
    frame_run: str | None
    component: int
    runs: tuple[LocatedRun, ...]
    not_located: tuple[NotLocated, ...] = ()
    moved: tuple[MovedTag, ...] = ()
    new: tuple[TagKey, ...] = ()
    warnings: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()
    converged: bool = True

    def __repr__(self) -> str:
        names = [run.name for run in self.runs]
        located, moved = ", ".join(names) or "nothing", plural(len(self.moved), "tag")
        return f"<Localization in {self.map}: located {located}; {moved} moved>"

    @property
    def is_located(self) -> bool:
        """Whether any segment was located."""
        return bool(self.runs)
