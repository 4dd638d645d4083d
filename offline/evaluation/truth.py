"""Ground truth of simulated drives: truth.json, on the logs' clock, in the world frame."""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray, StrPath
from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError

# Stamps of observations are estimates too: up to this far beyond the truth's ends, its end is used.
_END_TOLERANCE_NS: Final = 100_000_000

TagName = tuple[str, int, str]  # family, id, instance


@dataclass(frozen=True)
class TrueRun:
    """True trajectory of a robot."""

    stamps_ns: IntArray  # (N,), ascending
    T_world_base: FloatArray  # (N, 3)

    def poses_at(self, stamps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return poses (K, 3) at stamps (K,), on the arc between neighbours, and which stamps (K,) the truth covers."""
        first, last = self.stamps_ns[0], self.stamps_ns[-1]
        covered = (stamps_ns >= first - _END_TOLERANCE_NS) & (stamps_ns <= last + _END_TOLERANCE_NS)
        if len(self.stamps_ns) == 1:
            return np.broadcast_to(self.T_world_base[0], (len(stamps_ns), 3)).copy(), covered
        inside = np.clip(stamps_ns, first, last)
        before = np.clip(np.searchsorted(self.stamps_ns, inside, side="right") - 1, 0, len(self.stamps_ns) - 2)
        step_ns = self.stamps_ns[before + 1] - self.stamps_ns[before]
        fraction = (inside - self.stamps_ns[before]) / step_ns
        return se2.interpolate(self.T_world_base[before], self.T_world_base[before + 1], fraction), covered


@dataclass(frozen=True)
class Truth:
    """True trajectories and tag positions."""

    runs: dict[str, TrueRun]
    tags_m: dict[TagName, FloatArray]  # (2,) in the world frame
    ambiguous: frozenset[TagName]  # listed more than once


def read_truth(path: StrPath) -> Truth:
    """Read truth.json.

    Raises:
        OfflineError: missing, not JSON, or a key or value that is not as in docs/formats.md.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OfflineError(
            f"{path}: cannot be read ({error.strerror}); give the truth.json of the simulation"
        ) from error
    except (ValueError, RecursionError) as error:
        raise OfflineError(f"{path}: is not JSON ({error}); give the truth.json of the simulation") from error
    if not isinstance(data, dict) or not isinstance(data.get("runs"), dict) or not isinstance(data.get("tags"), list):
        is_map = isinstance(data, dict) and "components" in data
        raise OfflineError(
            f"{path}: is {'a map' if is_map else 'JSON'}, not ground truth, which holds runs{{name: {{poses}}}} and "
            "tags[{family, tag_id, position_m}]; give the truth.json of the simulation, or a survey with --survey"
        )
    try:
        runs = {name: _true_run(path, name, entry) for name, entry in data["runs"].items()}
        names = [(tag["family"], int(tag["tag_id"]), tag.get("instance") or "") for tag in data["tags"]]
        twice = frozenset(name for name, n in Counter(names).items() if n > 1)
        places = [np.array(tag["position_m"][:2], dtype=np.float64) for tag in data["tags"]]
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise OfflineError(
            f"{path}: lacks or misspells a key, or a number is out of range ({error}); it holds "
            "runs{name: {poses}} and tags[{family, tag_id, position_m}]; give the truth.json of the simulation"
        ) from error
    for (_, tag_id, _), place in zip(names, places, strict=True):
        if place.shape != (2,) or not np.isfinite(place).all():
            raise OfflineError(
                f"{path}: position_m of tag {tag_id} is {place.tolist()}, must be two finite numbers; correct it"
            )
    return Truth(runs, dict(zip(names, places, strict=True)), twice)


def _true_run(path: Path, name: str, entry: dict[str, Any]) -> TrueRun:
    poses = entry["poses"]
    if not poses or any(len(pose) != 4 for pose in poses):
        raise OfflineError(f"{path}: runs.{name}.poses must hold rows of t_ns, x_m, y_m, theta_rad; correct it")
    stamps_ns = np.array([pose[0] for pose in poses], dtype=np.int64)  # not via floats, which lose nanoseconds
    T_world_base = np.array([pose[1:] for pose in poses], dtype=np.float64)
    if (np.diff(stamps_ns) <= 0).any() or not np.isfinite(T_world_base).all():
        raise OfflineError(f"{path}: runs.{name}.poses has times not increasing or numbers not finite; correct it")
    return TrueRun(stamps_ns, T_world_base)
