"""Robots and tags calibrated by their own drives, as far as these know better than robot.yaml."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.robot import FOCAL_SCALE, IMPORTED_BATCH, TAG_SCALE, TIME_OFFSET, NoiseParameters
from groundsbot.offline.local_map import solve_local_map
from groundsbot.offline.maps import CalibrationChoice, CalibrationResult
from groundsbot.offline.measurements import Chain, Run
from groundsbot.offline.sam import efforts_of
from groundsbot.offline.self_calibration.information import told_by
from groundsbot.offline.self_calibration.robot import LIMITS, Learnt, Owned, corrected, opened
from groundsbot.offline.self_calibration.selection import choose

# Put right before the map is made, which takes them to first order, or on the floor not at all. Wheel readings are in
# metres by then, and stamps on one clock; both are as good to first order.
_SCALES: Final = frozenset({"track_scale", TAG_SCALE, FOCAL_SCALE})
TIMES_MAPPED: Final = 2  # the runs are, where this comes before their map
_ADDED: Final = frozenset({"mount_x_m", "mount_y_m", "mount_roll_rad", "mount_pitch_rad", "mount_yaw_rad", TIME_OFFSET})


_NOTHING: Final = Learnt(0.0, 0.0)


class Freed(NamedTuple):
    """Runs with what was freed left open in their robots' files, and why the rest was not."""

    runs: list[Run]
    choices: tuple[CalibrationChoice, ...]


def free_what_is_told(
    runs: Sequence[Run], chains: Sequence[Chain], noise: NoiseParameters, names: Collection[str], *, corners: bool
) -> Freed:
    """Frees what the drives can tell and robot.yaml has wrong.

    Args:
        runs: with what robot.yaml says.
        chains: of the runs.
        noise: that the chains are under.
        names: what to free whether robot.yaml is contradicted or not; where empty what drives contradict.
        corners: the map will be refined on corners, which tell of the focal length too.
    """
    efforts = efforts_of(chains, TIMES_MAPPED)
    maps = [solve_local_map(chain, effort).without_factors() for chain, effort in zip(chains, efforts, strict=True)]
    choices = choose(told_by(maps, noise, efforts, corners=corners), names)
    freed = {Owned(each.owner, each.name): LIMITS[each.name] for each in choices if each.is_freed}
    right = _put_right(choices)
    return Freed(
        [
            replace(
                run.retimed(right.get(Owned(run.robot_id, TIME_OFFSET), _NOTHING).value),
                robot=opened(corrected(run.robot, right), freed),
                camera=refocused(run.camera, right.get(Owned(run.robot_id, FOCAL_SCALE))),
            )
            for run in runs
        ],
        tuple(choices),
    )


def refocused(camera: CameraModel | None, focal: Learnt | None) -> CameraModel | None:
    """The camera with the focal lengths that were found."""
    if camera is None or focal is None:
        return camera
    return replace(camera, fx_px=camera.fx_px * (1.0 + focal.value), fy_px=camera.fy_px * (1.0 + focal.value))


def about_the_files(
    calibration: Sequence[CalibrationResult], choices: Sequence[CalibrationChoice]
) -> list[CalibrationResult]:
    """Corrections to the files as they were given: what was put right before is part of them."""
    right, found = _put_right(choices), []
    for each in calibration:
        before = right.get(Owned(each.owner, each.name), _NOTHING).value
        found.append(replace(each, value=_one_after_the_other(each.name, before, each.value)))
    return found


def _put_right(choices: Sequence[CalibrationChoice]) -> dict[Owned, Learnt]:
    """What was put into robots' files before the map was made; of a number that was twice, both together."""
    right: dict[Owned, Learnt] = {}
    for each in choices:
        if each.is_freed and each.name in _SCALES | _ADDED and not each.owner.startswith(IMPORTED_BATCH):
            owned = Owned(each.owner, each.name)
            before = right.get(owned, _NOTHING).value
            right[owned] = Learnt(_one_after_the_other(each.name, before, each.value), each.sigma)
    return right


def _one_after_the_other(name: str, before: float, after: float) -> float:
    """Two corrections of one number: shares of shares, or sums."""
    return before + after + (before * after if name in _SCALES else 0.0)
