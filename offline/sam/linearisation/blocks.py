"""Arrays of the compiled arrowhead system: the blocks of H, and the rows of R."""

from typing import NamedTuple

from groundsbot.offline.foundation import FloatBlocks, FloatMatrix, FloatVector


class NormalEquations(NamedTuple):
    """The normal equations H = J^T J and g = J^T r in blocks. Fixed columns are those of the identity.

    Attributes:
        pose: (P, 3, 3) diagonal blocks of the poses.
        pose_next: (P, 3, 3) blocks with the rows of a pose and the columns of the next one.
        pose_calibration: (P, 3, n_slots) blocks of pose and calibration of its segment.
        pose_tag: (M, 3, 2) blocks of pose and tag of each observation.
        tag: (T, 2, 2) diagonal blocks of the tags.
        tag_calibration: (Q, 2, n_slots) blocks of a tag and the calibration of a segment that observes it.
        calibration: (C, C) block of the calibration.
        gradient: (3P + 2T + C,) gradient g.
        distance: (D, 2, 5) Jacobian of each measured distance by pose and tag at each end. The diagonal blocks of its
            products are in `pose` and `tag` already.
    """

    pose: FloatBlocks
    pose_next: FloatBlocks
    pose_calibration: FloatBlocks
    pose_tag: FloatBlocks
    tag: FloatBlocks
    tag_calibration: FloatBlocks
    calibration: FloatMatrix
    gradient: FloatVector
    distance: FloatBlocks


class SquareRootFactor(NamedTuple):
    """The rows of R with R^T R = H, and work arrays of the elimination.

    Attributes:
        pose: (P, 3, 3) for poses in leaves: unit upper triangular U with 1 / D stored on its diagonal, R = sqrt(D) U.
        pose_next: (P, 3, 3) the part of U in the columns of the next pose of the leaf, or of the separator after it.
        inner: rows (n_eliminated, front) of the nodes between leaves and top, concatenated.
        workspace: one front per level during assembly; the last one is the top's.
        border: (2, 3, w) work array for the coupling of two poses to a leaf's front.
        blocks: (2, 3, 3) work array for two blocks.
        inside: (K, 3) work array for a vector in a leaf.
    """

    pose: FloatBlocks
    pose_next: FloatBlocks
    inner: FloatVector
    workspace: FloatVector
    border: FloatBlocks
    blocks: FloatBlocks
    inside: FloatMatrix
