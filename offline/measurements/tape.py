"""What a person measured with a tape: where a run started, and distances between starts or tags.

On the command line `--start RUN=x_m,y_m,theta_rad,sigma_x_m,sigma_y_m,sigma_theta_rad`, in the frame of the first log's
start, and `--distance A,B=metres,sigma_m`, where A and B are runs (their starts are meant) or tags: an id, or
FAMILY:ID where an id hangs in several families.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.tags import TagKey

# No tape is longer, none is finer, and a measurement that says less says nothing; squares of these are still numbers.
_FARTHEST_M: Final = 1e5
_LEAST_SIGMA: Final = 1e-5
_LARGEST_SIGMA: Final = 1e3


@dataclass(frozen=True)
class Placement:
    """A measured pose of frame b in frame a.

    Attributes:
        T_a_b: (3,)
        covariance: (3, 3) of its right tangent.
    """

    T_a_b: FloatArray
    covariance: FloatArray

    def inverse(self) -> "Placement":
        """Frame a in frame b."""
        turned = se2.adjoint(self.T_a_b)
        return Placement(se2.inverse(self.T_a_b), turned @ self.covariance @ turned.T)


@dataclass(frozen=True)
class MeasuredStart:
    """Where a run started, in the frame of the first log's start.

    Attributes:
        run: its name.
        T_map_start: (3,)
        sigma: (3,) of x_m, y_m in the map's axes, and theta_rad.
    """

    run: str
    T_map_start: FloatArray
    sigma: FloatArray

    @property
    def placement(self) -> Placement:
        """In the frame of the first log's start."""
        to_tangent = se2.right_tangent_from_coordinates(self.T_map_start)
        return Placement(self.T_map_start, to_tangent @ np.diag(self.sigma**2) @ to_tangent.T)


@dataclass(frozen=True)
class MeasuredDistance:
    """How far two things are apart: starts of runs, by name, or tags."""

    a: str | TagKey
    b: str | TagKey
    distance_m: float
    sigma_m: float


@dataclass(frozen=True)
class TapeOptions:
    """What stands on the command line: the texts of --start and of --distance."""

    starts: Sequence[str] = ()
    distances: Sequence[str] = ()


@dataclass(frozen=True)
class Measurements:
    """What a person measured.

    Attributes:
        frame: the run in whose start's frame starts are.
    """

    frame: str
    starts: tuple[MeasuredStart, ...] = ()
    distances: tuple[MeasuredDistance, ...] = ()

    def __len__(self) -> int:
        """How many there are."""
        return len(self.starts) + len(self.distances)

    def placements(self, runs: Sequence[str]) -> dict[tuple[int, int], Placement]:
        """What starts say of pairs of runs, by their indices, for `alignment.merging.merge`."""
        index = {name: i for i, name in enumerate(runs)}
        return {(index[self.frame], index[start.run]): start.placement for start in self.starts}


def parse_measurements(options: TapeOptions, runs: Sequence[str], tags: Sequence[TagKey]) -> Measurements:
    """All that is on the command line.

    Args:
        options: what was given.
        runs: names of the runs; the start of the first is the frame.
        tags: those that any run saw.

    Raises:
        OfflineError: one line that says what is wrong and what to write.
    """
    starts = tuple(parse_start(text, runs) for text in options.starts)
    names = [start.run for start in starts]
    for name in names:
        if names.count(name) > 1:
            raise OfflineError(f"--start: the start of {name} is given twice; leave one out")
    return Measurements(runs[0], starts, tuple(parse_distance(text, runs, tags) for text in options.distances))


def parse_start(text: str, runs: Sequence[str]) -> MeasuredStart:
    """From `RUN=x_m,y_m,theta_rad,sigma_x_m,sigma_y_m,sigma_theta_rad`.

    Args:
        text: what was given.
        runs: names of the runs; the start of the first is the frame.

    Raises:
        OfflineError: one line that says what is wrong and what to write.
    """
    option = f"--start {text}"
    name, numbers = _split(option, text, "RUN=x_m,y_m,theta_rad,sigma_x_m,sigma_y_m,sigma_theta_rad", 6)
    if name not in runs:
        raise OfflineError(f"{option}: there is no run {name!r}; the runs are {', '.join(runs)}")
    if name == runs[0]:
        raise OfflineError(f"{option}: {name} is the first run, whose start is the frame; give another run's start")
    _check_sigmas(option, dict(zip(("sigma_x_m", "sigma_y_m", "sigma_theta_rad"), numbers[3:], strict=True)))
    return MeasuredStart(name, np.array(numbers[:3]), np.array(numbers[3:]))


def parse_distance(text: str, runs: Sequence[str], tags: Sequence[TagKey]) -> MeasuredDistance:
    """From `A,B=metres,sigma_m`.

    Args:
        text: what was given.
        runs: names of the runs.
        tags: those that any run saw.

    Raises:
        OfflineError: one line that says what is wrong and what to write.
    """
    option = f"--distance {text}"
    names, (distance_m, sigma_m) = _split(option, text, "A,B=metres,sigma_m", 2)
    ends = [_end(option, name.strip(), runs, tags) for name in names.split(",")]
    if len(ends) != 2 or ends[0] == ends[1]:
        raise OfflineError(f"{option}: {names!r} must name two different runs or tags; write A,B=metres,sigma_m")
    if not 0.0 <= distance_m <= _FARTHEST_M:
        raise OfflineError(f"{option}: the distance is {distance_m:g} m, must be from 0 to {_FARTHEST_M:g}")
    _check_sigmas(option, {"sigma_m": sigma_m})
    return MeasuredDistance(ends[0], ends[1], distance_m, sigma_m)


def _split(option: str, text: str, form: str, n: int) -> tuple[str, list[float]]:
    """What stands before the last = sign, and the n numbers behind it."""
    name, equals, rest = text.rpartition("=")
    parts = rest.split(",")
    if not equals or not name or len(parts) != n:
        raise OfflineError(f"{option}: {len(parts)} numbers where {n} are wanted; write {form}")
    numbers = []
    for part in parts:
        try:
            numbers.append(float(part))
        except ValueError:
            numbers.append(float("nan"))
        if not isfinite(numbers[-1]):
            raise OfflineError(f"{option}: {part.strip()!r} is not a number; write {form}")
    return name.strip(), numbers


def _check_sigmas(option: str, sigmas: dict[str, float]) -> None:
    for name, value in sigmas.items():
        if not _LEAST_SIGMA <= value <= _LARGEST_SIGMA:
            raise OfflineError(f"{option}: {name} is {value:g}, must be from {_LEAST_SIGMA:g} to {_LARGEST_SIGMA:g}")


def _end(option: str, name: str, runs: Sequence[str], tags: Sequence[TagKey]) -> str | TagKey:
    if name in runs:
        return name
    family, _, number = name.rpartition(":")
    found = [tag for tag in tags if str(tag.tag_id) == number and family in ("", tag.family)]
    if not found:
        raise OfflineError(f"{option}: {name!r} is neither a run ({', '.join(runs)}) nor a tag that any run saw")
    if len(found) > 1:
        families = ", ".join(f"{tag.family}:{tag.tag_id}" for tag in found)
        raise OfflineError(f"{option}: tag {name} hangs in several families; write one of {families}")
    return found[0]
