"""What the compiled loops of the arrowhead system read and write: H by blocks, and the rows of R."""

from typing import NamedTuple

from groundsbot.calib.foundation import FloatArray


class NormalEquations(NamedTuple):
    """H = J^T J and g = J^T r in blocks. Columns that are held have a one on the diagonal and nothing else.

    Attributes:
        pose: (P, 3, 3) diagonal blocks; pose_next: (P, 3, 3) rows of a pose, columns of the next one.
        pose_calibration: (P, 3, n_slots) by the calibration of the pose's segment.
        pose_tag: (M, 3, 2) by the tag of each observation.
        tag: (T, 2, 2) diagonal blocks; tag_calibration: (T, 2, C).
        calibration: (C, C).
        gradient: (3P + 2T + C,).
        distance: (D, 2, 5) what each measured distance has by the pose and the tag at each of its ends. What that
            leaves on the diagonal is in `pose` and `tag` already.
    """

    pose: FloatArray
    pose_next: FloatArray
    pose_calibration: FloatArray
    pose_tag: FloatArray
    tag: FloatArray
    tag_calibration: FloatArray
    calibration: FloatArray
    gradient: FloatArray
    distance: FloatArray


class SquareRootFactor(NamedTuple):
    """What elimination leaves.

    Attributes:
        pose: (P, 3, 3) of the poses in leaves U with ones on the diagonal, and 1 / D in their place: R = sqrt(D) U.
        pose_next: (P, 3, 3) U by the next pose of the leaf or the separator after it.
        inner: rows (n_eliminated, front) of the nodes between leaves and top.
        workspace: fronts being built up, one a level; the last one is the top's.
        border, blocks, inside: room for what couples two poses to a leaf's front (2, 3, w), for two blocks (2, 3, 3),
            and for a vector in a leaf (K, 3).
    """

    pose: FloatArray
    pose_next: FloatArray
    inner: FloatArray
    workspace: FloatArray
    border: FloatArray
    blocks: FloatArray
    inside: FloatArray
