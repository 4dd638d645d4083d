"""The report's tables of how runs are connected, from the document that map.json is written from."""

from math import degrees
from typing import Any, Final

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.report.cells import (
    ReportTable,
    has_several_families,
    names_text,
    number,
    table_of,
    tag_label,
    tag_targets,
)
from groundsbot.offline.report.sentences import linking_tags

# Fewer shared tags determine no transform.
_LEAST_SHARED: Final = 2


def alignments(document: dict[str, Any]) -> ReportTable:
    """Return the table of aligned pairs of runs."""
    rows = []
    for each in document["alignments"]:
        x_m, y_m, theta_rad = each["transform"]
        rows.append(
            (
                each["from"],
                each["to"],
                f"{each['n_inliers']} of {each['n_shared']}",
                number(each["inlier_rmse_m"], 2),
                f"{x_m:.2f}, {y_m:.2f}",
                f"{degrees(theta_rad):.1f}",
                names_text([str(tag["tag_id"]) for tag in each["outliers"]]),
                _acceptance(each),
            )
        )
    columns = ("run", "joined with", "shared tags that fit", "RMS (m)", "x, y (m)", "yaw (deg)", "left out", "accepted")
    note = "Transform from each run's own map to another's, from the tags that both have."
    return table_of("alignments", "How the runs fit together", note, columns, rows)


def _acceptance(alignment: dict[str, Any]) -> str:
    if not alignment["is_sure"]:
        return f"no; {len(alignment['rivals'])} alternatives"
    if not alignment["is_weak"]:
        return "yes"
    x_m, y_m, theta_rad = (alignment["covariance"][i][i] ** 0.5 for i in range(3))
    return f"weak: one tag; sigma {x_m:.2f} m, {y_m:.2f} m, {degrees(theta_rad):.2f} deg"


def linking_tag_table(document: dict[str, Any]) -> ReportTable:
    """Return the table of tags that several runs observed."""
    several = has_several_families(document)
    target_of = {id(tag): target for tag, target in zip(document["tags"], tag_targets(document), strict=True)}
    rows, targets = [], []
    for component in range(len(document["components"])):
        essential = essential_tags(document, component)
        for tag in linking_tags(document, component):
            targets.append(target_of[id(tag)])
            is_essential = any(tag is other for other in essential)
            rows.append(
                (
                    tag_label(tag, several_families=several),
                    str(len(tag["runs"])),
                    names_text(tag["runs"]),
                    str(tag["n_observations"]),
                    number(tag["sigma_m"], 3),
                    "yes" if is_essential else "no",
                )
            )
    columns = ("tag", "runs", "observed by", "observations", "sigma (m)", "runs are disconnected without it")
    note = "The tags that more than one run observed, with the largest sigma relative to the map's frame."
    return table_of("holding", "Tags that connect the runs", note, columns, rows, targets)


def essential_tags(document: dict[str, Any], component: int) -> list[dict[str, Any]]:
    """Return linking tags that each disconnect the runs if removed, where two shared tags connect two runs."""
    links = linking_tags(document, component)
    index = {name: i for i, name in enumerate(document["components"][component]["runs"])}
    seen = np.zeros((len(links), len(index)))
    for row, tag in zip(seen, links, strict=True):
        row[[index[name] for name in tag["runs"]]] = 1.0
    shared = seen.T @ seen
    np.fill_diagonal(shared, 0.0)
    if not _are_joined(shared):
        return []
    # Of all trees that join the runs, this one has the strongest pairs. Only where a tag parts one of these, it can
    # disconnect the runs; so few tags are left to try.
    tree = minimum_spanning_tree(-np.where(shared >= _LEAST_SHARED, shared, 0.0)).tocoo()
    weakest = shared[tree.row, tree.col] == _LEAST_SHARED
    parts_pair = np.any(seen[:, tree.row[weakest]] * seen[:, tree.col[weakest]], axis=1)
    return [links[i] for i in np.flatnonzero(parts_pair) if not _are_joined(shared - np.outer(seen[i], seen[i]))]


def _are_joined(shared: FloatArray) -> bool:
    """Whether runs are connected, by the number (R, R) of tags that each two of them share."""
    n_parts, _ = connected_components(shared >= _LEAST_SHARED, directed=False)
    return bool(n_parts == 1)


def start_to_start(document: dict[str, Any]) -> ReportTable:
    """Return the table of distances between starts."""
    rows = [
        (each["a"], each["b"], number(each["distance_m"], 3), number(each["sigma_m"], 3))
        for each in document["start_to_start"]
    ]
    columns = ("from the start of", "to the start of", "distance (m)", "sigma (m)")
    return table_of("starts", "Start to start", "", columns, rows)
