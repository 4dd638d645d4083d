"""The report's tables of how runs are connected, from the document that map.json is written from."""

from collections.abc import Sequence
from itertools import combinations
from math import degrees
from typing import Any, Final

from groundsbot.offline.report.cells import ReportTable, has_several_families, number, table_of, tag_label, tag_targets
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
                ", ".join(str(tag["tag_id"]) for tag in each["outliers"]),
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
                    ", ".join(tag["runs"]),
                    str(tag["n_observations"]),
                    number(tag["sigma_m"], 3),
                    "yes" if is_essential else "no",
                )
            )
    columns = ("tag", "runs", "observed by", "observations", "sigma (m)", "runs are disconnected without it")
    note = "The tags that more than one run observed."
    return table_of("holding", "Tags that connect the runs", note, columns, rows, targets)


def essential_tags(document: dict[str, Any], component: int) -> list[dict[str, Any]]:
    """Return linking tags that each disconnect the runs if removed, where two shared tags connect two runs."""
    links = linking_tags(document, component)
    names = document["components"][component]["runs"]
    if not _are_joined(names, links):
        return []
    return [tag for tag in links if not _are_joined(names, [other for other in links if other is not tag])]


def _are_joined(names: Sequence[str], links: Sequence[dict[str, Any]]) -> bool:
    shared = dict.fromkeys(combinations(names, 2), 0)
    for tag in links:
        runs = set(tag["runs"])
        for pair in combinations([name for name in names if name in runs], 2):
            shared[pair] += 1
    reached = {names[0]}
    joined = [set(pair) for pair, n in shared.items() if n >= _LEAST_SHARED]
    while more := [pair for pair in joined if len(pair & reached) == 1]:
        reached = reached.union(*more)
    return len(reached) == len(names)


def start_to_start(document: dict[str, Any]) -> ReportTable:
    """Return the table of distances between starts."""
    rows = [
        (each["a"], each["b"], number(each["distance_m"], 3), number(each["sigma_m"], 3))
        for each in document["start_to_start"]
    ]
    columns = ("from the start of", "to the start of", "distance (m)", "sigma (m)")
    return table_of("starts", "Start to start", "", columns, rows)
