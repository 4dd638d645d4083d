"""Division of a problem into parts with numbers of their own, and what remains for the process that joins them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Final, NamedTuple, TypeVar

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS
from groundsbot.offline.sam.arrowhead.build import Kept, build_arrowhead, is_in_joint_prior, segment_starts
from groundsbot.offline.sam.arrowhead.system import Arrowhead
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    OdometryFactors,
    State,
)
from groundsbot.offline.sam.factors.priors import NO_PRIORS, Priors, StartFactors
from groundsbot.offline.sam.solver import Problem

_NONE: Final = np.zeros(0, dtype=np.int64)
_NO_ODOMETRY: Final = OdometryFactors(
    _NONE, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3), dtype=np.int64)
)
_NO_OBSERVATIONS: Final = ObservationFactors(
    pose=_NONE,
    tag=_NONE,
    value=np.zeros((0, 2)),
    polar=np.zeros(0, dtype=np.bool_),
    whitening=np.zeros((0, 2, 2)),
    mount=np.zeros((0, 3)),
    mount_parameters=np.zeros((0, 3), dtype=np.int64),
    scale_parameter=_NONE,
    by_camera=np.zeros((0, 2, len(CAMERA_PARAMETERS))),
    camera_parameters=np.zeros((0, len(CAMERA_PARAMETERS)), dtype=np.int64),
    turning_rad_s=np.zeros(0),
)

_Factors = TypeVar("_Factors", OdometryFactors, ObservationFactors, StartFactors)


class PartNumbers(NamedTuple):
    """The variables of a part among those of the whole.

    Attributes:
        first, end: its poses are first to end - 1.
        tags: (t,) tags that it observes, in ascending order.
        calibration: (c,) parameters that its factors use, in ascending order.
        in_top: (k,) columns of the top's arrowhead that it shares, in ascending order: those of the starts of its
            segments, and of its tags and free calibration that are in the top.
    """

    first: int
    end: int
    tags: IntArray
    calibration: IntArray
    in_top: IntArray


@dataclass(frozen=True)
class ProblemPart:
    """The factors of some consecutive segments, with numbers of their own.

    Attributes:
        odometry, observations, starts: factors.
        columns: columns of its variables; -1 where fixed.
        prior: of the calibration that no other part depends on; else infinite.
        kept_tags: those of its tags that are in the top.
        kept_calibration: those of its parameters that are in the top, fixed ones included.
        numbers: its variables among those of the whole.
    """

    odometry: OdometryFactors
    observations: ObservationFactors
    starts: StartFactors
    columns: Columns
    prior: CalibrationPrior
    kept_tags: IntArray
    kept_calibration: IntArray
    numbers: PartNumbers


@dataclass(frozen=True)
class Whole:
    """What the process that joins the parts knows of all: numbers, and the factors between parts.

    Attributes:
        columns: columns of P poses, T tags and C calibration parameters in the tangent vector.
        anchor: (T,) as in `Problem`.
        segment_start: (S + 1,) first pose of each segment, then the number of poses.
        top_tags: (K,) tags in the top, in ascending order.
        top_calibration: (L,) parameters in the top, in ascending order; fixed ones are.
        prior: of all calibration.
        measured: distances and the joint prior of a finished map; measured starts are in the parts.
    """

    columns: Columns
    anchor: IntArray
    segment_start: IntArray
    top_tags: IntArray
    top_calibration: IntArray
    prior: CalibrationPrior
    measured: Priors = NO_PRIORS

    @cached_property
    def arrowhead(self) -> Arrowhead:
        """The arrowhead of the top alone: starts of segments, tags and calibration, with the factors between parts.

        Raises:
            ValueError: a distance ends at a pose that is no start of a segment, or at a tag that is not in the top.
        """
        starts = self.segment_start[:-1]
        columns = _renumber(self.columns, starts, self.top_tags, self.top_calibration)
        kept = Kept(np.arange(len(starts)), np.arange(len(self.top_tags)))
        measured = _among(self.measured, starts, self.top_tags, self.top_calibration)
        prior, own = self.prior, self.top_calibration
        of_top = CalibrationPrior(prior.sigma[own], prior.rows[:, own] if len(prior.rows) else prior.rows, prior.values)
        return build_arrowhead(_NO_ODOMETRY, _NO_OBSERVATIONS, of_top, columns, measured, kept)

    def top_state(self, state: State) -> State:
        """Return the values of the top's variables."""
        return State(
            state.poses[self.segment_start[:-1]], state.tags[self.top_tags], state.calibration[self.top_calibration]
        )

    @cached_property
    def top_in_tangent(self) -> IntArray:
        """Column (n,) of the top's arrowhead for each column of the tangent vector; -1 where it is not in the top."""
        columns = self.columns
        calibration = columns.calibration[self.top_calibration]
        own = [columns.poses[self.segment_start[:-1]], columns.tags[self.top_tags], calibration[calibration >= 0]]
        of_top = np.concatenate([each.reshape(-1) for each in own])
        found = np.full(columns.n, -1)
        found[of_top[of_top >= 0]] = np.flatnonzero(of_top >= 0)
        return found


def divide(
    problem: Problem, first_poses: Sequence[int], top_tags: IntArray | None = None
) -> tuple[Whole, list[ProblemPart]]:
    """Return a problem in parts.

    Args:
        problem: the whole.
        first_poses: first pose of each part, in ascending order from 0; each is the start of a segment.
        top_tags: tags whose covariance is wanted, which are kept in the top; None for all tags and calibration. Tags in
            several parts or with a prior are kept as well, and those that no part observes. So is calibration.

    Raises:
        ValueError: a part does not begin with a segment.
    """
    columns, n_poses = problem.columns, len(problem.columns.poses)
    segment_start = segment_starts(problem.odometry, n_poses)
    bounds = np.array([*first_poses, n_poses])
    if bounds[0] != 0 or not np.isin(bounds, segment_start).all() or (np.diff(bounds) <= 0).any():
        raise ValueError("parts must begin with the first pose of a segment, the first one with pose 0")
    odometry = _cut(problem.odometry, problem.odometry.first, bounds)
    observations = _cut(problem.observations, problem.observations.pose, bounds)
    starts = _cut(problem.measured.starts, problem.measured.starts.pose, bounds)
    n_parts_of_tag = np.zeros(len(columns.tags), dtype=np.int64)
    for own in observations:
        n_parts_of_tag[np.unique(own.tag)] += 1
    is_in_top = n_parts_of_tag != 1
    is_in_top[problem.measured.tags] = True
    is_in_top[slice(None) if top_tags is None else top_tags] = True
    whole = Whole(
        columns,
        problem.anchor,
        segment_start,
        np.flatnonzero(is_in_top),
        np.arange(len(columns.calibration))
        if top_tags is None
        else _shared_calibration(problem, odometry, observations),
        problem.prior,
        replace(problem.measured, starts=NO_PRIORS.starts),
    )
    each = zip(bounds[:-1].tolist(), bounds[1:].tolist(), odometry, observations, starts, strict=True)
    return whole, [part_of(whole, *own) for own in each]


def part_of(
    whole: Whole,
    first: int,
    end: int,
    odometry: OdometryFactors,
    observations: ObservationFactors,
    starts: StartFactors = NO_PRIORS.starts,
) -> ProblemPart:
    """Return the part of the poses first to end - 1, from its factors with the numbers of the whole."""
    tags, calibration = np.unique(observations.tag), _used_calibration(odometry, observations)
    kept = np.flatnonzero(np.isin(tags, whole.top_tags, assume_unique=True))
    is_shared = np.isin(calibration, whole.top_calibration, assume_unique=True)
    return ProblemPart(
        odometry=replace(
            odometry, first=odometry.first - first, parameters=np.searchsorted(calibration, odometry.parameters)
        ),
        observations=replace(
            observations,
            pose=observations.pose - first,
            tag=np.searchsorted(tags, observations.tag),
            mount_parameters=np.searchsorted(calibration, observations.mount_parameters),
            scale_parameter=np.searchsorted(calibration, observations.scale_parameter),
            camera_parameters=np.searchsorted(calibration, observations.camera_parameters),
        ),
        starts=replace(starts, pose=starts.pose - first),
        columns=_renumber(whole.columns, np.arange(first, end), tags, calibration),
        prior=CalibrationPrior(np.where(is_shared, np.inf, whole.prior.sigma[calibration])),
        kept_tags=kept,
        kept_calibration=np.flatnonzero(is_shared),
        numbers=PartNumbers(
            first, end, tags, calibration, _in_top(whole, first, end, tags[kept], calibration[is_shared])
        ),
    )


def _in_top(whole: Whole, first: int, end: int, tags: IntArray, calibration: IntArray) -> IntArray:
    """Return columns of the top's arrowhead: of the starts between two poses, of tags and of calibration."""
    starts = whole.segment_start[:-1]
    own = np.flatnonzero((starts >= first) & (starts < end))
    first_tag = 3 * len(starts)
    first_free = first_tag + 2 * len(whole.top_tags)
    is_free = whole.columns.calibration[whole.top_calibration] >= 0
    at = np.searchsorted(whole.top_calibration, calibration)
    return np.concatenate(
        [
            (3 * own[:, None] + np.arange(3)).reshape(-1),
            (first_tag + 2 * np.searchsorted(whole.top_tags, tags)[:, None] + np.arange(2)).reshape(-1),
            first_free + (np.cumsum(is_free) - 1)[at[is_free[at]]],
        ]
    )


def _used_calibration(odometry: OdometryFactors, observations: ObservationFactors) -> IntArray:
    """Return the parameters (c,) that factors use, in ascending order, and the first one, which is fixed."""
    of_observations = [observations.mount_parameters, observations.camera_parameters, observations.scale_parameter]
    used = [odometry.parameters, *of_observations]
    return np.unique(np.concatenate([[0], *(each.reshape(-1) for each in used)]))


def _shared_calibration(
    problem: Problem, odometry: Sequence[OdometryFactors], observations: Sequence[ObservationFactors]
) -> IntArray:
    """Return the parameters in the top: those fixed, of several parts or of none, and those that priors couple."""
    n_parts = np.zeros(len(problem.columns.calibration), dtype=np.int64)
    for own in zip(odometry, observations, strict=True):
        n_parts[_used_calibration(*own)] += 1
    is_coupled = is_in_joint_prior(problem.prior, problem.measured)
    return np.flatnonzero((n_parts != 1) | (problem.columns.calibration < 0) | is_coupled)


def _renumber(columns: Columns, poses: IntArray, tags: IntArray, calibration: IntArray) -> Columns:
    """Return columns of some variables alone: poses, tags, calibration."""
    own = columns.poses[poses], columns.tags[tags], columns.calibration[calibration]
    is_free = np.concatenate([each.reshape(-1) for each in own]) >= 0
    numbers = np.where(is_free, np.cumsum(is_free) - 1, -1)
    ends = np.cumsum([each.size for each in own])
    split = np.split(numbers, ends[:-1])
    return Columns(split[0].reshape(-1, 3), split[1].reshape(-1, 2), split[2], int(is_free.sum()))


def _cut(factors: _Factors, poses: IntArray, bounds: IntArray) -> list[_Factors]:
    """Return the factors of the poses between bounds, each kind in the order it has."""
    order = np.argsort(poses, kind="stable")
    at = np.searchsorted(poses[order], bounds)
    found = []
    for first, end in pairwise(at.tolist()):
        own = {each.name: getattr(factors, each.name)[order[first:end]] for each in fields(factors)}
        found.append(type(factors)(**own))
    return found


def _among(measured: Priors, starts: IntArray, tags: IntArray, calibration: IntArray) -> Priors:
    """Return distances and joint prior with the numbers of starts, tags and calibration in the top."""
    distances, known = measured.distances, measured.known
    numbered = replace(
        distances,
        pose_a=_number(distances.pose_a, starts),
        pose_b=_number(distances.pose_b, starts),
        tag_a=_number(distances.tag_a, tags),
        tag_b=_number(distances.tag_b, tags),
    )
    own = replace(known, tags=_number(known.tags, tags), calibration=_number(known.calibration, calibration))
    return Priors(NO_PRIORS.starts, numbered, own)


def _number(wanted: IntArray, among: IntArray) -> IntArray:
    """Return the position of each number in an ascending list; -1 for -1.

    Raises:
        ValueError: a number is not in it.
    """
    there = wanted >= 0
    if not np.isin(wanted[there], among).all():
        raise ValueError("a measured distance must end at the first pose of a segment or at a tag in the top")
    return np.where(there, np.searchsorted(among, wanted), -1)
