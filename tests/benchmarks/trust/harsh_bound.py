"""How accurate any estimate of harsh drives can be on the floor plane: the Cramer-Rao bound, from the truth.

Independent of the estimate: from the true poses and the model of `fixtures.drives.harsh`, on range and bearing. Unknown
are a pose wherever a tag is read, each tag's place, and the robots' numbers, of which only the wide priors are known
that the simulator draws them from. Errors of observations are what the switches say; those of pixels besides. Outliers
and the way in which `speeds` spoils the wheels are taken for known, so the bound lies below what can be reached.

Of Student's t with nu degrees of freedom and scale s the information is that of a normal distribution with a variance
of s^2 (nu + 3) / (nu + 1) (Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989).
"""

import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.fixtures.drives.harsh import (
    MOUNT_M,
    MOUNT_YAW_RAD,
    RANGE_OFFSET_M,
    TAG_SCALE,
    TIME_OFFSET_S,
    TURNS,
    Harsh,
)
from groundsbot.offline.measurements.run import Run
from tests.benchmarks.trust.harsh_information import (
    N_ROBOT,
    drive_of,
    information_of_observations,
    information_of_wheels,
    true_observations,
)


def shape_bound_m(runs: Sequence[Run], truth: Path, harsh: Collection[Harsh]) -> float:
    """The least RMSE in metres of the tags that the runs saw, moved and turned onto the truth.

    Args:
        runs: of one seed.
        truth: truth.json of the same.
        harsh: the switches that are on.
    """
    told: dict[str, Any] = json.loads(truth.read_text(encoding="utf-8"))
    places = {(tag["family"], tag["tag_id"]): np.array(tag["position_m"][:2]) for tag in told["tags"]}
    seen = sorted({key for run in runs for key in _tags_seen(run, told)})
    index = {key: i for i, key in enumerate(seen)}
    tags_m = np.array([places[key] for key in seen])
    return _rmse_of_shape(_tag_covariance(runs, told, harsh, [index] * len(runs), tags_m), tags_m)


def shift_sigmas(runs: Sequence[Run], truth: Path, harsh: Collection[Harsh]) -> dict[int, float]:
    """By how many sigmas of what can be known at most each changed tag was moved, all other tags where they were.

    Args:
        runs: of one seed, driven one after the other; tags were changed after the first.
        truth: truth.json of the same, where a changed tag has two places, instances a and b.
        harsh: the switches that are on.

    Returns:
        By id; of tags that only one side of the change read, nothing is known: they are left out.
    """
    told: dict[str, Any] = json.loads(truth.read_text(encoding="utf-8"))
    first = min(runs, key=lambda run: int(told["runs"][run.name]["poses"][0][0]))
    places = {
        (tag["family"], tag["tag_id"], tag.get("instance") or ""): np.array(tag["position_m"][:2])
        for tag in told["tags"]
    }

    def named(run: Run, key: tuple[str, int]) -> tuple[str, int, str]:
        return (*key, ("a" if run is first else "b") if (*key, "b") in places else "")

    seen = sorted({named(run, key) for run in runs for key in _tags_seen(run, told)})
    index = {name: i for i, name in enumerate(seen)}
    of_runs = [{key: index[named(run, key)] for key in _tags_seen(run, told)} for run in runs]
    tags_m = np.array([places[name] for name in seen])
    covariance = _tag_covariance(runs, told, harsh, of_runs, tags_m)
    found = {}
    for family, tag_id, instance in seen:
        if instance == "a" and (family, tag_id, "b") in index:
            i, j = index[family, tag_id, "a"], index[family, tag_id, "b"]
            rows = [2 * i, 2 * i + 1, 2 * j, 2 * j + 1]
            difference = np.hstack([-np.eye(2), np.eye(2)])
            off_m = tags_m[j] - tags_m[i]
            shift = difference @ covariance[np.ix_(rows, rows)] @ difference.T
            found[tag_id] = float(np.sqrt(off_m @ np.linalg.solve(shift, off_m)))
    return found


def _tags_seen(run: Run, told: dict[str, Any]) -> set[tuple[str, int]]:
    """Family and id of the tags that a run read rightly."""
    return {
        (run.tags[t].family, run.tags[t].tag_id) for t in true_observations(run, told["runs"][run.name])[1].tolist()
    }


def _tag_covariance(
    runs: Sequence[Run],
    told: dict[str, Any],
    harsh: Collection[Harsh],
    indices: Sequence[dict[tuple[str, int], int]],
    tags_m: FloatArray,
) -> FloatArray:
    """(2T, 2T) the bound of the tags (T, 2), which each run's observations are of by its index; first pose held."""
    drives = [drive_of(run, told["runs"][run.name], index) for run, index in zip(runs, indices, strict=True)]
    n_poses = sum(len(each.poses) for each in drives)
    tags_at, robots_at = 3 * n_poses, 3 * n_poses + 2 * len(tags_m)
    n = robots_at + N_ROBOT * len(drives) + 1
    information = sparse.lil_matrix((n, n))
    information.setdiag(
        np.append(np.zeros(robots_at), np.append(_prior_sigmas(runs, harsh), _tag_sigma(harsh)) ** -2.0)
    )
    total = sparse.csc_matrix(information)
    first = 0
    for i, drive in enumerate(drives):
        robot = robots_at + N_ROBOT * i
        observations = information_of_observations(drive, tags_m, first, tags_at, robot, n, harsh)
        total = sparse.csc_matrix(total + information_of_wheels(drive, first, robot, n) + observations)
        first += 3 * len(drive.poses)
    # A frame, to have a covariance at all: what the shape is does not depend on it.
    held = sparse.csc_matrix((np.full(3, 1e6), (np.arange(3), np.arange(3))), shape=(n, n))
    columns = np.arange(tags_at, robots_at)
    units = np.zeros((n, len(columns)))
    units[columns, np.arange(len(columns))] = 1.0
    return np.asarray(splu(sparse.csc_matrix(total + held)).solve(units)[columns])


def _rmse_of_shape(covariance: FloatArray, tags_m: FloatArray) -> float:
    """Of tags (T, 2) with covariance (2T, 2T), what moves and turns all of them alike taken out."""
    about = tags_m - tags_m.mean(axis=0)
    ones, none = np.ones(len(about)), np.zeros(len(about))
    together = np.stack([ones, none, none, ones, -about[:, 1], about[:, 0]], axis=-1)
    basis, _ = np.linalg.qr(np.stack([together[:, :2], together[:, 2:4], together[:, 4:]], axis=-1).reshape(-1, 3))
    rest = np.eye(len(covariance)) - basis @ basis.T
    return float(np.sqrt(np.trace(rest @ covariance @ rest) / len(about)))


def _prior_sigmas(runs: Sequence[Run], harsh: Collection[Harsh]) -> FloatArray:
    """(8R,) of the robots' numbers: robot.yaml's, or the deviation of the distribution that a switch draws from."""
    found = []
    for run in runs:
        wheels, mount = run.robot.wheels, run.robot.mount
        left, right = (
            wheels.radius_left_m_sigma / wheels.radius_left_m,
            wheels.radius_right_m_sigma / wheels.radius_right_m,
        )
        sigmas = [
            0.5 * np.hypot(left, right), np.hypot(left, right), wheels.track_m_sigma / wheels.track_m,
            mount.x_m_sigma, mount.y_m_sigma, mount.yaw_rad_sigma, run.robot.time_offset_s_sigma, 1e-6,
        ]  # fmt: skip
        if Harsh.TURNS in harsh:
            sigmas[2] = (TURNS[1] - TURNS[0]) / 12**0.5
        if Harsh.MOUNT in harsh:
            sigmas[3:6] = [MOUNT_M / 6**0.5, MOUNT_M / 6**0.5, 2 * MOUNT_YAW_RAD / 12**0.5]
        if Harsh.TIME in harsh:
            sigmas[6] = (TIME_OFFSET_S[1] - TIME_OFFSET_S[0]) / 12**0.5
        if Harsh.RANGES in harsh:
            sigmas[7] = 2 * RANGE_OFFSET_M / 12**0.5
        found += sigmas
    return np.array(found)


def _tag_sigma(harsh: Collection[Harsh]) -> float:
    return 2 * TAG_SCALE / 12**0.5 if Harsh.SCALE in harsh else 0.005
