"""The map of runs that are being recorded, made anew from what was read of them so far."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.live.drives import Drives, RunState
from groundsbot.offline.live.fitting import Fitting
from groundsbot.offline.live.thinning import thin
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.mapping import Diagnostics, EarlierMap, build_map
from groundsbot.offline.maps import MapResult
from groundsbot.offline.measurements import RobotFile, Run


@dataclass(frozen=True)
class Update:
    """What is known of the runs now.

    Attributes:
        runs: their states.
        is_finished: whether the recorders have finished all of them.
        result: the newest map; None before anything can be mapped.
        workings: diagnostics of the same map.
        trouble: why the newest data gave no map, or no fit of noise and calibration; else empty.
        is_new: whether the map is another one than that of the update before.
    """

    runs: tuple[RunState, ...]
    is_finished: bool = False
    result: MapResult | None = None
    workings: Diagnostics | None = None
    trouble: str = ""
    is_new: bool = False


class LiveMap:
    """Follows runs and maps them. Noise and calibration are fitted from time to time, and stay in between."""

    def __init__(
        self,
        paths: Sequence[Path],
        robot_files: Mapping[str, RobotFile] | None = None,
        noise: NoiseParameters | None = None,
        workers: Workers | None = None,
    ) -> None:
        """Begin without reading.

        Args:
            paths: files, run folders, or folders of runs; they need not exist yet.
            robot_files: calibrations by robot id that replace those in the logs.
            noise: sigmas of wheels and tag observations; None: they are fitted.
            workers: where a process for fits is started; None: they are made within updates.
        """
        self._drives = Drives(paths, robot_files or {})
        self._fitting = Fitting(noise, workers)
        self._earlier = EarlierMap() if noise is None else EarlierMap(noise)
        self._n_mapped = 0  # messages
        self._why_no_fit = ""
        self._last = Update(())

    def update(self, stages: Stages | None = None) -> Update:
        """Read what is new in the logs, and map all runs.

        Args:
            stages: notified of progress, and records times.
        """
        self._drives.read()
        has_fit = self._take_fit()
        if self._drives.n_messages == self._n_mapped and not has_fit:
            found = replace(self._last, is_new=False)
        else:
            found = self._map(self._drives.measurements(), stages or Stages())
        self._last = replace(found, runs=self._drives.states(), is_finished=self._drives.is_finished)
        return self._last

    def _map(self, runs: Sequence[Run], stages: Stages) -> Update:
        """Map runs as far as they were read; without a map of them the one before stays."""
        self._n_mapped = self._drives.n_messages
        if not runs:
            return replace(self._last, is_new=False)
        runs, workings = thin(runs), Diagnostics()
        self._fitting.offer(runs, self._n_mapped)
        if not self._fitting.is_in_background:
            self._take_fit()
        try:
            result = build_map(runs, stages=stages, workings=workings, earlier=self._earlier)
        except GroundsbotError as error:
            return replace(self._last, trouble=str(error), is_new=False)
        self._earlier = replace(self._earlier, local_maps={each.segment.name: each for each in workings.maps})
        return Update((), result=result, workings=workings, trouble=self._why_no_fit, is_new=True)

    def _take_fit(self) -> bool:
        """Take over noise and calibration if there is a new fit, and return whether there is one."""
        fit = self._fitting.take()
        if fit is None:
            return False
        self._why_no_fit = fit.trouble
        if fit.earlier is not None:
            self._earlier = replace(fit.earlier, local_maps=_fitting_maps(self._earlier.local_maps))
        return fit.earlier is not None


def _fitting_maps(maps: Mapping[str, LocalMap]) -> dict[str, LocalMap]:
    """Return the local maps that fit; others begin anew under another noise and calibration."""
    return {name: each for name, each in maps.items() if each.goodness.fits}
