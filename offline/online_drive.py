"""What a robot has driven and read since it was put down, to be solved as a whole when there is time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib import se2
from calib.arrays import FloatArray
from calib.robot import Robot
from offline.chain import Chain
from offline.goodness import Goodness
from offline.graph import Parameter, build_graph
from offline.held_run import solve_held
from offline.kept_maps import measured_chain, run_without_log
from offline.known_map import KnownMap
from offline.local_map import LocalMap, solve_local_map
from offline.located import Located, locate
from offline.online_filter import OnlineFilter
from offline.run import TagKey
from offline.solver import Solution

_NAME: Final = "the drive"
_COMPONENT: Final = 0  # there is one only
_UNJUDGED: Final = Goodness(0.0, 0, 0.0, 1.0, 1.0)


@dataclass(frozen=True)
class TagReading:
    """One tag seen once.

    Attributes:
        family, tag_id: of the tag.
        value: (2,) range_m and bearing_rad, left positive; or x_m and y_m.
        covariance: (2, 2) of the value.
        by_camera: (2, 3) its derivative by mount_roll_rad, mount_pitch_rad and time_offset_s; None where not known.
        polar: which form.
        in_camera: about the camera's place and yaw, else about base.
    """

    family: str
    tag_id: int
    value: FloatArray
    covariance: FloatArray
    by_camera: FloatArray | None = None
    polar: bool = True
    in_camera: bool = True


class Drive:
    """Motions and readings in order of time: some 10 MB in an hour."""

    def __init__(self, robot: Robot) -> None:
        """Has not moved yet."""
        self._robot = robot
        self._motions: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._poses = [np.zeros(3)]
        self._readings: list[tuple[int, TagKey, TagReading]] = []

    def add_motion(self, motion: FloatArray, covariance: FloatArray, by_wheels: FloatArray, pose: FloatArray) -> None:
        """A motion, and the pose that it led to."""
        self._motions.append((motion, covariance, by_wheels))
        self._poses.append(pose)

    def add_reading(self, tag: TagKey, reading: TagReading) -> None:
        """Of a tag, from the last pose."""
        self._readings.append((len(self._motions), tag, reading))

    def move_frame(self, T_new_old: FloatArray) -> None:
        """All poses into another frame."""
        self._poses = list(se2.compose(T_new_old, np.array(self._poses)))

    def settle(
        self,
        state: OnlineFilter,
        known: KnownMap,
        parameters: Sequence[Parameter],
        tags: Sequence[TagKey],
        held: Mapping[TagKey, TagKey],
        loose: Mapping[TagKey, TagKey],
        placed: Located | None = None,
    ) -> dict[TagKey, TagKey]:
        """Solves it all, tags that were moved apart, and gives the filter what comes of it.

        Args:
            state: takes mean and covariance; calibration that nothing read depends on stays.
            known: the map.
            parameters: of the filter.
            tags: of the filter, in its order.
            held: the map's tag of each of those that hold the robot.
            loose: likewise of those that do not.
            placed: where the drive lies by `judged`, which the solve then starts from; else from where the filter is.

        Returns:
            The map's tag of each that holds it now.
        """
        if placed is None or placed.alignment is None:
            start = self._poses[0]
            member = self._local_map(state, tags, parameters, start)
        else:
            start, member = placed.alignment.T_a_b, placed.local_map
        found = solve_held([member], start[None], [dict(held)], [dict(loose)], known)
        solution, columns = found.solution, found.graph.problem.columns
        self._poses = list(solution.state.poses)
        own = {parameter: i for i, parameter in enumerate(found.graph.parameters)}
        at = [own.get(parameter, -1) for parameter in parameters]
        where = [found.graph.tags.index(found.called[0].get(tag, tag)) for tag in tags]
        of_numbers = np.array([-1 if i < 0 else columns.calibration[i] for i in at], dtype=np.int64)
        wanted = np.concatenate([columns.poses[-1], of_numbers, columns.tags[where].reshape(-1)])
        values = [state.calibration[n] if i < 0 else solution.state.calibration[i] for n, i in enumerate(at)]
        covariance = solution.covariance(wanted)
        state.set_to(self._poses[-1], np.array(values), solution.state.tags[where], covariance, of_numbers >= 0)
        return {tag: name for tag, name in found.called[0].items() if name in known.index}

    def judged(self, known: KnownMap) -> Located | None:
        """Where it lies in the map as `localize` would say, whatever the filter holds; None without tags of the map."""
        tags = {tag for _, tag, _ in self._readings}
        if not tags & known.instances.keys():
            return None
        return locate(solve_local_map(self._chain(sorted(tags))), known, _COMPONENT)

    def _local_map(
        self, state: OnlineFilter, tags: Sequence[TagKey], parameters: Sequence[Parameter], start: FloatArray
    ) -> LocalMap:
        """In the frame of its start, as the filter has it."""
        chain = self._chain(tags)
        graph = build_graph([chain])
        T_start_map = se2.inverse(start)
        places = dict(zip(tags, se2.apply(T_start_map, state.tags), strict=True))
        numbers = dict(zip(parameters, state.calibration.tolist(), strict=True))
        begun = graph.start(se2.compose(T_start_map, np.array(self._poses)), places, numbers)
        unsolved = Solution(begun, (graph.problem.cost(begun),), "as filtered", converged=False, problem=graph.problem)
        return LocalMap(chain, graph, unsolved, _UNJUDGED)

    def _chain(self, seen_tags: Sequence[TagKey]) -> Chain:
        tags = tuple(sorted(seen_tags))
        index = {tag: i for i, tag in enumerate(tags)}
        keyframe, seen, readings = zip(*self._readings, strict=True)
        by_camera = [np.zeros((2, 3)) if each.by_camera is None else each.by_camera for each in readings]
        return measured_chain(
            run_without_log(_NAME, self._robot, tags),
            np.arange(len(self._poses)),
            tuple(np.array(each) for each in zip(*self._motions, strict=True)),
            tags,
            np.array(keyframe),
            np.array([index[tag] for tag in seen]),
            np.array([each.value for each in readings], dtype=np.float64),
            np.array([each.covariance for each in readings], dtype=np.float64),
            np.array(by_camera, dtype=np.float64),
            np.array([each.polar for each in readings]),
            np.array([each.in_camera for each in readings]),
        )
