"""Distance of two tags by the corners of single pictures: `python -m tests.benchmarks.accuracy.pnp_distance LOG 9 10`.

Each picture that saw both gives one distance, by a general PnP of each tag: no odometry, no mount, no assumption about
how tags are mounted. The scatter is that between pictures; common errors (calibration, size of tags) are not in it.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from groundsbot.calib.camera import CameraModel, board_pose
from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.measurements import UNIT_CORNERS
from groundsbot.onboard.log import TagDetections, camera_from_message, read_log
from groundsbot.onboard.log.messages import CameraCalibration


def picture_distances(log: Path, tags: tuple[int, int], side_m: float) -> FloatArray:
    """Return the distance in each picture that saw both tags."""
    flat = np.column_stack([UNIT_CORNERS * side_m, np.zeros(4)])
    camera: CameraModel | None = None
    found = []
    for _, message, *_ in read_log(log):
        if isinstance(message, CameraCalibration):
            camera = camera_from_message(message)
        if camera is None or not isinstance(message, TagDetections):
            continue
        corners = {each.tag_id: np.reshape(each.corners_px, (4, 2)) for each in message.detections}
        poses = [board_pose(flat, camera.unproject(corners[tag])) for tag in tags if tag in corners]
        places = [pose[1] for pose in poses if pose is not None]
        found += [float(np.linalg.norm(a - b)) for a, b in pairwise(places)]
    return np.array(found)


def main() -> None:
    """Print the mean distance and its scatter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path, help="a run's folder")
    parser.add_argument("tags", type=int, nargs=2)
    parser.add_argument("--tag-size-m", type=float, default=0.1651)
    given = parser.parse_args()
    distances = picture_distances(given.log, tuple(given.tags), given.tag_size_m)
    print(f"{len(distances)} pictures: {distances.mean():.4f} m, scatter {distances.std(ddof=1):.4f} m")  # noqa: T201


if __name__ == "__main__":
    main()
