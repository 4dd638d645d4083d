"""The corners of pictures taken from one standing pose as one set for each tag."""

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray


def average_corners(
    keyframe: IntArray, tag: IntArray, corners_px: FloatArray, stamps_ns: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """One set of corners for each tag and keyframe; for each of several tags with one id that a picture shows.

    Args:
        keyframe: (M,) of each detection.
        tag: (M,) an index each; one detection at least.
        corners_px: (M, 4, 2)
        stamps_ns: (M,) of their pictures.

    Returns:
        (N,) keyframes, (N,) tags, and (N, 4, 2) means of their corners.
    """
    n_tags = int(tag.max()) + 1
    pairs, group = np.unique(keyframe * n_tags + tag, return_inverse=True)
    twin = np.zeros(len(tag), dtype=np.int64)
    pictures, in_picture = np.unique(np.column_stack([group, stamps_ns]), axis=0, return_counts=True)
    for pair in np.unique(pictures[in_picture > 1, 0]).tolist():
        own = np.flatnonzero(group == pair)
        twin[own] = _duplicates(corners_px[own], stamps_ns[own])
    pairs = pairs[group] * (int(twin.max()) + 1) + twin
    pairs, first, group, count = np.unique(pairs, return_index=True, return_inverse=True, return_counts=True)
    total = np.zeros((len(pairs), 4, 2))
    np.add.at(total, group, corners_px)
    return keyframe[first], tag[first], total / count[:, None, None]


def _duplicates(corners_px: FloatArray, stamps_ns: IntArray) -> IntArray:
    """(M,) which of several tags with one id each set of corners from one standing pose is of.

    Printed squares do not overlap, so that centres nearer than half a side are one tag read twice.
    """
    centre_px = corners_px.mean(axis=1)
    half_side_px = 0.5 * np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=1), axis=-1).max(axis=1)
    found = np.zeros(len(corners_px), dtype=np.int64)
    known: list[int] = []
    _, picture, count = np.unique(stamps_ns, return_inverse=True, return_counts=True)
    for each in np.argsort(-count, kind="stable").tolist():  # first a picture that shows all
        for i in np.flatnonzero(picture == each).tolist():
            away_px = np.linalg.norm(centre_px[known] - centre_px[i], axis=-1)
            is_new = bool((away_px > half_side_px[i]).all())
            found[i] = len(known) if is_new else int(np.argmin(away_px))
            known += [i] * is_new
    return found
