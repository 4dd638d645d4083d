"""Long drives in a finished map: the online estimate with its fixed lag beside one that linearises the whole again.

    python -m tests.benchmarks.accuracy.fixed_lag_study [--seeds 0-19] [--length-m 1000]

The scenes are those of localize_study, with a longer drive. Every 25th keyframe counts: the error of the position, its
NEES per dimension, and how far the poses with the lag are from those without, in sigmas of the latter.
"""

import argparse
import sys
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.localization.online import smoother
from groundsbot.offline.localization.online.localizer import OnlineLocalizer
from tests.benchmarks.accuracy.localize_study import Scene, make_scene, taken_one_by_one
from tests.benchmarks.command_line import say, seeds_of

_EVERY: Final = 25
_UNLIMITED: Final = 10**9


class Followed(NamedTuple):
    """Poses (N, 3) at some keyframes, NaN where not known, and their covariances (N, 3, 3)."""

    poses: FloatArray
    covariances: FloatArray


def follow(scene: Scene, lag: int) -> Followed:
    """Return the online estimate at every 25th keyframe."""
    usual, smoother._LAG = smoother._LAG, lag  # type: ignore[misc] # its constant
    try:
        online = OnlineLocalizer(scene.known, scene.drive.segment.run.robot)
        poses, covariances = [], []
        for k, (motion, observations) in enumerate(taken_one_by_one(scene.drive.segment)):
            if motion is not None:
                online.add_motion(*motion)
            for observation in observations:
                online.add_observation(observation)
            if k % _EVERY == 0:
                pose = online.pose
                poses.append(np.full(3, np.nan) if pose is None else pose.T_map_base)
                covariances.append(np.full((3, 3), np.nan) if pose is None else pose.covariance)
    finally:
        smoother._LAG = usual  # type: ignore[misc]
    return Followed(np.array(poses), np.array(covariances))


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    off = a - b
    off[:, 2] = se2.wrap_angle(off[:, 2])
    return off


def _squares(off: FloatArray, covariances: FloatArray) -> FloatArray:
    return np.asarray((off * np.linalg.solve(covariances, off[..., None])[..., 0]).sum(axis=1))


def main() -> int:
    """Prints a line a seed, and the mean of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, default=range(20))
    parser.add_argument("--length-m", type=float, default=1000.0)
    given = parser.parse_args()
    lines = []
    for seed in given.seeds:
        scene = make_scene(seed, given.length_m)
        if scene is None:
            say(f"seed {seed}: the map's drives are not joined")
            continue
        true = scene.T_map_base[::_EVERY]
        whole, lagged = follow(scene, _UNLIMITED), follow(scene, smoother._LAG)
        known = np.isfinite(whole.poses[:, 0]) & np.isfinite(lagged.poses[:, 0])
        rms_m, nees = [], []
        for each in (whole, lagged):
            off = _difference(each.poses, true)[known, :2]
            rms_m.append(float(np.sqrt((off**2).sum(axis=1).mean())))
            nees.append(float(_squares(off, each.covariances[known, :2, :2]).mean()) / 2.0)
        apart = np.sqrt(_squares(_difference(lagged.poses, whole.poses)[known], whole.covariances[known]))
        lines.append([*rms_m, *nees, float(apart.mean()), float(apart.max())])
        say(f"seed {seed}: {len(scene.T_map_base)} keyframes, {_words(lines[-1])}")
    say(f"mean: {_words(np.mean(lines, axis=0).tolist())}")
    return 0


def _words(line: list[float]) -> str:
    whole_m, lagged_m, whole, lagged, mean, most = line
    return (
        f"whole {whole_m:.3f} m, NEES {whole:.2f}; with the lag {lagged_m:.3f} m, NEES {lagged:.2f}; "
        f"apart {mean:.3f} sigma (mean), {most:.3f} (most)"
    )


if __name__ == "__main__":
    sys.exit(main())
