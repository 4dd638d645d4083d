"""Tape measurements: the start pose of a run, and distances between starts or tags.

The command line has `--start RUN=x_m,y_m,theta_rad,sigma_x_m,sigma_y_m,sigma_theta_rad`, in the frame of the first
log's start, and `--distance A,B=metres,sigma_m`. A and B are runs, which stand for their starts, or tags: an id, or
FAMILY:ID where several families have the id.
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

# Limits of what a tape can measure usefully; the squares of these are finite and not zero.
_FARTHEST_M: Final = 1e5
_LEAST_SIGMA: Final = 1e-5
_LARGEST_SIGMA: Final = 1e3


@dataclass(frozen=True)
class Placement:
    """A measured pose of frame b in frame a.

    Attributes:
        T_a_b: (3,) x_m, y_m, theta_rad.
        covariance: (3, 3) of its right tangent.
    """

    T_a_b: FloatArray
    covariance: FloatArray

    def inverse(self) -> "Placement":
        """Return the pose of frame a in frame b, with its covariance."""
        adjoint = se2.adjoint(self.T_a_b)
        return Placement(se2.inverse(self.T_a_b), adjoint @ self.covariance @ adjoint.T)


@dataclass(frozen=True)
class MeasuredStart:
    """The measured start pose of a run, in the frame of the first log's start.

    Attributes:
        run: its name.
        T_map_start: (3,) x_m, y_m, theta_rad.
        sigma: (3,) of the same, in the map's axes.
    """

    run: str
    T_map_start: FloatArray
    sigma: FloatArray

    @property
    def placement(self) -> Placement:
        """The same as a pose with the covariance of its right tangent."""
        to_tangent = se2.right_tangent_from_coordinates(self.T_map_start)
        return Placement(self.T_map_start, to_tangent @ np.diag(self.sigma**2) @ to_tangent.T)


@dataclass(frozen=True)
class MeasuredDistance:
    """A measured distance between two points, each the start of a run (by name) or a tag."""

    a: str | TagKey
    b: str | TagKey
    distance_m: float
    sigma_m: float


@dataclass(frozen=True)
class TapeOptions:
    """The texts given on the command line with --start and --distance."""

    starts: Sequence[str] = ()
    distances: Sequence[str] = ()


@dataclass(frozen=True)
class Measurements:
    """All tape measurements.

    Attributes:
        frame: the run whose start is the frame of `starts`.
        starts: measured start poses.
        distances: measured distances.
    """

    frame: str
    starts: tuple[MeasuredStart, ...] = ()
    distances: tuple[MeasuredDistance, ...] = ()

    def __len__(self) -> int:
        """Number of measurements."""
        return len(self.starts) + len(self.distances)

    def placements(self, runs: Sequence[str]) -> dict[tuple[int, int], Placement]:
        """Return the starts as relative poses of pairs of runs, by their indices, for `alignment.merging.merge`."""
        index = {name: i for i, name in enumerate(runs)}
        return {(index[self.frame], index[start.run]): start.placement for start in self.starts}


def parse_measurements(options: TapeOptions, runs: Sequence[str], tags: Sequence[TagKey]) -> Measurements:
    """Parse the tape measurements given on the command line.

    Args:
        options: the texts.
        runs: names of the runs; the start of the first is the frame.
        tags: observed by any run.

    Raises:
        OfflineError: a text is malformed, or names an unknown run or tag.
    """
    starts = tuple(parse_start(text, runs) for text in options.starts)
    names = [start.run for start in starts]
    for name in names:
        if names.count(name) > 1:
            raise OfflineError(f"--start: the start of {name} is given twice; leave one out")
    return Measurements(runs[0], starts, tuple(parse_distance(text, runs, tags) for text in options.distances))


def parse_start(text: str, runs: Sequence[str]) -> MeasuredStart:
    """Parse `RUN=x_m,y_m,theta_rad,sigma_x_m,sigma_y_m,sigma_theta_rad`.

    Args:
        text: given with --start.
        runs: names of the runs; the start of the first is the frame.

    Raises:
        OfflineError: the text is malformed, or its run is unknown or the first one.
    """
    option = f"--start {text}"
    name, numbers = _split(option, text, "RUN=x_m,y_m,theta_rad,sigma_x_m,sigma_y_m,sigma_theta_rad", 6)
    if name not in runs:
        raise OfflineError(f"{option}: the logs hold no run {name!r}; use one of {', '.join(runs)}")
    if name == runs[0]:
        raise OfflineError(f"{option}: {name} is the first run, whose start is the frame; give another run's start")
    _check_sigmas(option, dict(zip(("sigma_x_m", "sigma_y_m", "sigma_theta_rad"), numbers[3:], strict=True)))
    return MeasuredStart(name, np.array(numbers[:3]), np.array(numbers[3:]))


def parse_distance(text: str, runs: Sequence[str], tags: Sequence[TagKey]) -> MeasuredDistance:
    """Parse `A,B=metres,sigma_m`.

    Args:
        text: given with --distance.
        runs: names of the runs.
        tags: observed by any run.

    Raises:
        OfflineError: the text is malformed, or a run or tag is unknown.
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
    """Return the text before the last equals sign and the n numbers after it."""
    name, equals, rest = text.rpartition("=")
    parts = rest.split(",")
    if not equals or not name or len(parts) != n:
        raise OfflineError(f"{option}: {len(parts)} numbers given, {n} needed; write {form}")
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
        raise OfflineError(f"{option}: {name!r} is neither a run ({', '.join(runs)}) nor a tag that any run observed")
    if len(found) > 1:
        families = ", ".join(f"{tag.family}:{tag.tag_id}" for tag in found)
        raise OfflineError(f"{option}: tag id {name} occurs in several tag families; write one of {families}")
    return found[0]
