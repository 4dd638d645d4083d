"""A small map of two drives, made once for the tests that write it in other forms."""

from pathlib import Path

import numpy as np

from groundsbot.offline.commands.map_drives import MapOptions, make_map
from tests.support.data.drives import HALL, make_drive, make_robot, write_drive

TAGS = [HALL[i] for i in (0, 1, 2, 4, 6, 7)]
STARTS = {"carl": np.array([1.0, 1.5, 0.3]), "dora": np.array([4.0, 2.5, 2.9])}
LEGS = [(0.4, 0.4, 2.0), (-0.3, 0.3, 6.0), (0.4, 0.5, 2.0)]


def make_small_map(folder: Path) -> Path:
    """Two noisy drives past six tags, mapped into `folder/map`, in the frame of carl's start."""
    logs = []
    for seed, (robot, start) in enumerate(STARTS.items()):
        drive = make_drive(start.tolist(), LEGS, step_ns=20_000_000)
        logs.append(
            write_drive(folder / "logs", drive, TAGS, make_robot(robot), run_id="one", corner_sigma_px=0.3, seed=seed)
        )
    make_map(MapOptions(logs, folder / "map"))
    return folder / "map"
