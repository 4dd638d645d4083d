"""Diagnostics of a map, for the report and the advice."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment import Group
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import Run
from groundsbot.offline.sam import Graph, Solution
from groundsbot.offline.self_calibration import FreedRobots, OwnedParameter, TimeOffsetSearch


class SolvedGroup(NamedTuple):
    """One component, as it was solved.

    Attributes:
        group: indices into `Diagnostics.maps`, and where the alignments put their starts.
        graph: its segments are the group's members in order, its tags those of the component in order.
        solution: solution of that graph.
        poses: (P, 3) of its keyframes in the map: refined on corners where possible.

    Graph and solution are in the frame of the first segment's start, group and poses in the map's.
    """

    group: Group
    graph: Graph
    solution: Solution
    poses: FloatArray

    def poses_of(self, segment: int) -> FloatArray:
        """Return poses (K, 3) of one segment."""
        first = int(self.graph.first_pose[segment])
        return self.poses[first : first + len(self.graph.segments[segment].stamps_ns)]

    def move_to(self, T_map_start: FloatArray | None) -> "SolvedGroup":
        """Return it in a map in which the first segment's start has a pose (3,); None: that start is the frame."""
        if T_map_start is None:
            return self
        group = replace(self.group, T_frame_start=se2.compose(T_map_start, self.group.T_frame_start))
        return self._replace(group=group, poses=se2.compose(T_map_start, self.poses))


@dataclass
class Diagnostics:
    """Filled by `build_map`.

    Attributes:
        maps: the local maps as they were aligned.
        components: the solved ones, largest first.
        runs: as they were given, without their measurements.
        freed: the runs as they were mapped, likewise, and what self-calibration found.
        keeps_corners: maps and components keep corners, also those of a map that is not refined on them.
    """

    maps: list[LocalMap] = field(default_factory=list)
    components: list[SolvedGroup] = field(default_factory=list)
    runs: list[Run] = field(default_factory=list)
    freed: FreedRobots | None = None
    keeps_corners: bool = False

    @property
    def searches(self) -> dict[OwnedParameter, TimeOffsetSearch]:
        """Searches of time offsets."""
        return {} if self.freed is None else self.freed.searches
