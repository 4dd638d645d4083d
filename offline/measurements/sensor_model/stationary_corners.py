"""Averages the corners of pictures that were taken from one pose while the robot stands."""

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray


def average_corners(
    keyframe: IntArray, tag: IntArray, corners_px: FloatArray, stamps_ns: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Average the corners of each tag at each keyframe.

    Several tags with one id in one picture are averaged separately.

    Args:
        keyframe: (M,) of each detection, M at least one.
        tag: (M,) index of the tag of each detection.
        corners_px: (M, 4, 2) raw pixels.
        stamps_ns: (M,) of their pictures.

    Returns:
        (N,) keyframes, (N,) tags, and (N, 4, 2) mean corners.
    """
    n_tags = int(tag.max()) + 1
    pairs, group = np.unique(keyframe * n_tags + tag, return_inverse=True)
    instance = np.zeros(len(tag), dtype=np.int64)
    pictures, in_picture = np.unique(np.column_stack([group, stamps_ns]), axis=0, return_counts=True)
    for pair in np.unique(pictures[in_picture > 1, 0]).tolist():
        own = np.flatnonzero(group == pair)
        instance[own] = _instances(corners_px[own], stamps_ns[own])
    pairs = pairs[group] * (int(instance.max()) + 1) + instance
    pairs, first, group, count = np.unique(pairs, return_index=True, return_inverse=True, return_counts=True)
    total = np.zeros((len(pairs), 4, 2))
    np.add.at(total, group, corners_px)
    return keyframe[first], tag[first], total / count[:, None, None]


def _instances(corners_px: FloatArray, stamps_ns: IntArray) -> IntArray:
    """Return (M,) which of several tags with one id each set of corners from one pose belongs to.

    Tags do not overlap, so centres nearer than half a side are of one tag that was detected twice.
    """
    centre_px = corners_px.mean(axis=1)
    half_side_px = 0.5 * np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=1), axis=-1).max(axis=1)
    instance = np.zeros(len(corners_px), dtype=np.int64)
    known: list[int] = []
    _, picture, count = np.unique(stamps_ns, return_inverse=True, return_counts=True)
    for each in np.argsort(-count, kind="stable").tolist():  # begin with a picture that shows all instances
        for i in np.flatnonzero(picture == each).tolist():
            distance_px = np.linalg.norm(centre_px[known] - centre_px[i], axis=-1)
            is_new = bool((distance_px > half_side_px[i]).all())
            instance[i] = len(known) if is_new else int(np.argmin(distance_px))
            known += [i] * is_new
    return instance
