"""Drives of a simulated world as the estimate takes them, and the truth."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.fixtures.worlds.world import World
from groundsbot.offline.evaluation.truth import Truth, read_truth
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.measurements.run import Run
from groundsbot.onboard.log.reading.reader import find_logs


def simulated_runs(
    world: World | str | Path, seed: int, robots: Sequence[str] | None = None, **options: Any
) -> tuple[list[Run], Truth]:
    """The runs of a seed, not rendered unless asked for; `options` as of `simulate`. No files are left."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "drives"
        simulate(world, seed, folder, robots, **{"render": False, **options})
        return read_runs(find_logs([folder])), read_truth(folder / TRUTH_FILE)
