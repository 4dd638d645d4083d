"""A component's graph as g2o text: github.com/RainerKuemmerle/g2o/wiki/File-Format, types of its slam2d.

Keyframes are VERTEX_SE2, tags VERTEX_XY; motions EDGE_SE2, observations EDGE_SE2_XY. The first keyframe is the frame:
FIX.
"""

from collections.abc import Iterator

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.maps import Component, GraphEdges


def g2o_text(component: Component) -> str:
    """Return vertices and edges, a line each; then the fixed vertex, and comments that name the vertices.

    These must come last: gtsam's reader ignores edges after a comment or FIX.

    Raises:
        OfflineError: the map holds no graph.
    """
    if component.edges is None:
        raise OfflineError("map.npz holds no graph, as an older version made it; make the map again")
    first_tag = sum(run.n_keyframes for run in component.runs)
    lines = [*_vertices(component), *_edges(component.edges, first_tag), "FIX 0", *_names(component)]
    return "\n".join(lines) + "\n"


def _vertices(component: Component) -> Iterator[str]:
    poses = np.concatenate([run.T_map_base for run in component.runs]).tolist()
    for i, pose in enumerate(poses):
        yield f"VERTEX_SE2 {i} {_join(pose)}"
    for i, tag in enumerate(component.tags, start=len(poses)):
        yield f"VERTEX_XY {i} {_join(tag.position_m.tolist())}"


def _names(component: Component) -> Iterator[str]:
    first = 0
    for run in component.runs:
        yield f"# run {run.name}: vertices {first} to {first + run.n_keyframes - 1}"
        first += run.n_keyframes
    for i, tag in enumerate(component.tags, start=first):
        yield f"# tag {tag.family} {tag.label}: vertex {i}"


def _edges(edges: GraphEdges, first_tag: int) -> Iterator[str]:
    motions = zip(edges.first.tolist(), edges.motion.tolist(), _upper(edges.motion_information), strict=True)
    for first, motion, information in motions:
        yield f"EDGE_SE2 {first} {first + 1} {_join(motion)} {_join(information)}"
    places = zip(
        edges.pose.tolist(),
        (edges.tag + first_tag).tolist(),
        edges.place_m.tolist(),
        _upper(edges.place_information),
        strict=True,
    )
    for pose, tag, place, information in places:
        yield f"EDGE_SE2_XY {pose} {tag} {_join(place)} {_join(information)}"


def _upper(matrices: FloatArray) -> list[list[float]]:
    """Return the upper triangles, row by row."""
    rows, columns = np.triu_indices(matrices.shape[-1])
    found: list[list[float]] = matrices[:, rows, columns].tolist()
    return found


def _join(values: list[float]) -> str:
    return " ".join(map(repr, values))
