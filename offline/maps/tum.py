"""Trajectories as TUM text, which evo and others read: `t_s x y z qx qy qz qw` per line."""

from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray, atomic_write
from groundsbot.offline.errors import OfflineError

_NS_PER_S: Final = 1_000_000_000


def write_tum(path: Path, stamps_ns: IntArray, T_map_base: FloatArray) -> None:
    """Write poses (N, 3) of a robot on the floor, at stamps (N,): seconds with all nine decimals."""
    half = 0.5 * T_map_base[:, 2]
    lines = [
        f"{stamp // _NS_PER_S}.{stamp % _NS_PER_S:09d} {x:.9f} {y:.9f} 0 0 0 {sin:.12f} {cos:.12f}\n"
        for stamp, x, y, sin, cos in zip(
            stamps_ns.tolist(), *T_map_base[:, :2].T.tolist(), np.sin(half).tolist(), np.cos(half).tolist(), strict=True
        )
    ]
    with atomic_write(path) as partial:
        partial.write_text("".join(lines), encoding="ascii")


def read_tum(path: Path) -> tuple[IntArray, FloatArray]:
    """Return stamps (N,) in ns and poses (N, 3) as (x_m, y_m, theta_rad).

    Raises:
        OfflineError: the file is missing, empty, or a line is not such a pose.
    """
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise OfflineError(f"{path}: cannot be read ({error}); make the map again") from error
    stamps_ns, poses = [], []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            stamp, x, y, _, _, _, qz, qw = line.split()
            stamps_ns.append(np.int64(int(Decimal(stamp) * _NS_PER_S)))
            poses.append([float(x), float(y), 2.0 * np.arctan2(float(qz), float(qw))])
        except (ValueError, ArithmeticError) as error:
            raise OfflineError(f"{path} line {number}: {line[:80]!r} is not a pose; make the map again") from error
    if not poses:
        raise OfflineError(f"{path}: holds no pose; make the map again")
    table = np.array(poses)
    table[:, 2] = np.arctan2(np.sin(table[:, 2]), np.cos(table[:, 2]))
    return np.array(stamps_ns, dtype=np.int64), table
