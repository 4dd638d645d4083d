"""What each part of the order of explanation is good for: real and harsh drives with one of them left out.

    python -m tests.benchmarks.trust.ablation_study [--data ../shared/data] [--seeds 0-9]

Left out, one at a time: *systematic errors* (a robot is what its file says: of imports with the sigmas of a measured
robot), *overruling* (`--calibrate off`), *lasting noise* (the default noise, nothing fitted), *outliers
last* (outliers are searched for under the default noise, before it is fitted). A row each: components,
tags, RMS of the landmarks after rotation and translation, NEES of tags, tags named. Real drives are MRCLAM ds2, ds4,
ds9, and the paper's, for which the distance between the starts stands instead; harsh ones are `nsh`, over the seeds.
"""

import argparse
import csv
import sys
import tempfile
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Final
from unittest import mock

import numpy as np

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.drives.harsh import Harsh
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.local_map.incremental_solve import InitialValues
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import Segment
from groundsbot.offline.outliers.kinds import PHANTOM
from groundsbot.offline.sam.budget import Budget
from groundsbot.offline.self_calibration.option import Calibrate
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.command_line import say, seeds_of
from tests.support.data.simulated_runs import simulated_runs

VARIANTS: Final = ("nothing", "systematic errors", "overruling", "lasting noise", "outliers last")


def map_runs(runs: Sequence[Run], without: str) -> MapResult:
    """The map of runs with one part left out."""
    calibrate = Calibrate(is_on=without not in ("overruling", "systematic errors"))
    if without == "systematic errors":
        runs = [_as_measured(run) for run in runs]
    early = mock.patch("groundsbot.offline.outliers.local_maps_without_outliers.solve_local_map", _not_noisy)
    with early if without == "outliers last" else nullcontext():
        return build_map(runs, NoiseParameters() if without == "lasting noise" else None, calibrate=calibrate)


def _not_noisy(segment: Segment, budget: Budget, *, noise_is_open: bool, start: InitialValues | None) -> LocalMap:
    """Solves a drive whose noise is to be fitted, and takes it for one whose noise is given."""
    return replace(solve_local_map(segment, budget, noise_is_open=noise_is_open, start=start), is_noisy=False)


def _as_measured(run: Run) -> Run:
    """The run of a robot whose file has small sigmas for parameters that were not measured."""
    robot = run.robot
    if not robot.is_left_open:
        return run
    wheels = robot.wheels.model_copy(update={"track_m_sigma": 0.01 * robot.wheels.track_m})
    mount = robot.mount.model_copy(update={"x_m_sigma": 0.005, "y_m_sigma": 0.005, "yaw_rad_sigma": 0.0087})
    numbers = {"time_offset_s_sigma": 0.001, "range_offset_m_sigma": 0.0, "imported_tag_scale_sigma": 0.02}
    return replace(run, robot=robot.model_copy(update={"wheels": wheels, "mount": mount, **numbers}))


def landmarks_rms_m(result: MapResult, survey: Path) -> tuple[float, float]:
    """RMS of the largest component's landmarks after rotation and translation, and their NEES per dimension."""
    with survey.open() as rows:
        places = {int(row["tag_id"]): (float(row["x_m"]), float(row["y_m"])) for row in csv.DictReader(rows)}
    component = result.components[0]
    which = [i for i, tag in enumerate(component.tags) if tag.tag_id in places and tag.instance in ("", "a")]
    found = np.array([component.tags[i].position_m for i in which])
    true = np.array([places[component.tags[i].tag_id] for i in which])
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    U, _, V = np.linalg.svd(found.T @ true)
    turn = U @ np.diag([1.0, np.sign(np.linalg.det(U @ V))]) @ V
    off = found - true @ turn.T
    rows_of = (np.array(which)[:, None] * 2 + np.arange(2)).reshape(-1)
    covariance = component.tag_covariance[np.ix_(rows_of, rows_of)]
    n, turned = len(which), np.stack([-found[:, 1], found[:, 0]], axis=-1).reshape(-1)
    gauge = np.stack([np.tile([1.0, 0.0], n), np.tile([0.0, 1.0], n), turned], axis=-1)
    basis, _ = np.linalg.qr(gauge, mode="complete")
    rest = basis[:, 3:]
    z = rest.T @ off.reshape(-1)
    nees = float(z @ np.linalg.solve(rest.T @ covariance @ rest, z)) / len(z)
    return float(np.sqrt((off**2).sum(axis=1).mean())), nees


def _n_named(result: MapResult) -> int:
    return sum(each.kind != PHANTOM for each in result.outliers)


def real(data: Path) -> None:
    """Real recordings."""
    for name in ("ds2", "ds4", "ds9", "paper"):
        with tempfile.TemporaryDirectory() as folder:
            source = data / "nsh_first_floor" if name == "paper" else data / "mrclam" / name
            options = ImportOptions(state_rate_hz=4.2, track_width_m=0.508) if name == "paper" else ImportOptions()
            for run in sorted(each for each in source.iterdir() if each.is_dir()):
                import_folder(run, Path(folder) / "logs", options)
            runs = read_runs(find_logs([Path(folder) / "logs"]))
            for without in VARIANTS:
                result = map_runs(runs, without)
                row = f"{name} without {without}: {len(result.components)} components, {_tags(result)} tags, "
                if name == "paper":
                    pairs = result.components[0].start_to_start
                    row += ", ".join(f"{each.distance_m:.2f} m (sigma {each.sigma_m:.2f} m)" for each in pairs)
                else:
                    rms_m, nees = landmarks_rms_m(result, source / "survey.csv")
                    row += f"RMS {rms_m:.3f} m, NEES {nees:.2f}"
                say(f"{row}, {_n_named(result)} named")


def _tags(result: MapResult) -> int:
    return sum(len(each.tags) for each in result.components)


def harsh(seeds: Sequence[int]) -> None:
    """Simulated drives of `nsh`."""
    rows: dict[str, list[tuple[int, float, float, int]]] = {each: [] for each in VARIANTS}
    for seed in seeds:
        runs, truth = simulated_runs("nsh", seed, harsh=list(Harsh))
        for without, found in rows.items():
            result = map_runs(runs, without)
            errors = evaluate(result, truth).components[0]
            shape_m, nees = errors.tags_rmse_aligned_m or np.nan, errors.nees_tags_per_dim or np.nan
            found.append((len(result.components), shape_m, nees, _n_named(result)))
    for without, found in rows.items():
        n, shape_m, nees, named = np.array(found, dtype=np.float64).T
        say(
            f"harsh nsh without {without}: {(n == 1).mean():.2f} in one component, shape "
            f"{np.sqrt(np.nanmean(shape_m**2)):.2f} m RMS (median {np.nanmedian(shape_m):.2f}), NEES "
            f"{np.nanmean(nees):.2f} (median {np.nanmedian(nees):.2f}), {named.mean():.2f} named a map"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="real recordings [../shared/data]")
    parser.add_argument("--seeds", type=seeds_of, default="0-9", help="of harsh drives: FIRST-LAST or one seed [0-9]")
    given = parser.parse_args(arguments)
    if given.data.is_dir():
        real(given.data)
    harsh(given.seeds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
