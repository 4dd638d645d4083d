"""The report's tables, from the document that map.json is written from."""

from collections import Counter
from math import degrees
from typing import Any

from groundsbot.offline.report.accuracy_texts import frame_name
from groundsbot.offline.report.cells import (
    ReportTable,
    has_several_families,
    names_text,
    number,
    table_of,
    tag_targets,
)
from groundsbot.offline.report.join_tables import alignments, linking_tag_table, start_to_start
from groundsbot.offline.report.parameter_tables import checks, measurements, noise, robots, scale_table
from groundsbot.offline.report.sentences import advice_sentence


def tables(document: dict[str, Any]) -> list[ReportTable]:
    """Return the tables that are not empty."""
    made = [
        _outliers(document),
        _advice(document),
        alignments(document),
        linking_tag_table(document),
        start_to_start(document),
        robots(document),
        checks(document),
        scale_table(document),
        measurements(document),
        _runs(document),
        _tags(document),
        noise(document),
    ]
    return [table for table in made if table.rows]


def _outliers(document: dict[str, Any]) -> ReportTable:
    rows = [
        (str(each["tag_id"]), each["family"], each["kind"], names_text(each["runs"]), each["evidence"])
        for each in document["suspect_tags"]
    ]
    targets = tag_targets(document)
    places = [
        " ".join(
            target
            for tag, target in zip(document["tags"], targets, strict=True)
            if (tag["family"], tag["tag_id"]) == (each["family"], each["tag_id"])
        )
        for each in document["suspect_tags"]
    ]
    note = "Tags with observations that contradict the map, each with the evidence."
    return table_of("suspects", "Suspect tags", note, ("tag", "family", "kind", "runs", "evidence"), rows, places)


def _advice(document: dict[str, Any]) -> ReportTable:
    several = has_several_families(document)
    rows = [
        (
            str(each["component"] + 1),
            advice_sentence(each, several_families=several),
            number(each["sigma_m"], 3),
            number(each["sigma_then_m"], 3),
        )
        for each in document["advice"]
    ]
    rows = list({row[:2]: row for row in rows}.values())  # that nothing would help is said once
    note = (
        "What would reduce the largest sigma of a tag relative to the others most, predicted from the covariances; "
        "drawn into the map."
    )
    columns = ("component", "what", "largest sigma (m)", "predicted (m)")
    return table_of("advice", "What to do next", note, columns, rows)


def _runs(document: dict[str, Any]) -> ReportTable:
    rows = []
    n_tags = Counter(run for tag in document["tags"] for run in tag["runs"])
    for run in document["runs"]:
        x_m, y_m, theta_rad = run["T_map_start"]
        rows.append(
            (
                run["run"],
                run["robot"],
                str(run["component"] + 1),
                str(run["n_keyframes"]),
                number(run["distance_m"], 1),
                str(n_tags[run["run"]]),
                f"{x_m:.2f}, {y_m:.2f}",
                f"{degrees(theta_rad):.1f}",
                run["log"],
            )
        )
    columns = ("run", "robot", "component", "keyframes", "driven (m)", "tags", "start x, y (m)", "heading (deg)", "log")
    return table_of("runs", "Runs", "", columns, rows)


def _tags(document: dict[str, Any]) -> ReportTable:
    rows = []
    for tag in document["tags"]:
        covariance = tag["covariance"]
        rows.append(
            (
                f"{tag['tag_id']}{tag['instance']}",
                tag["family"],
                str(tag["component"] + 1),
                *(number(value, 3) for value in tag["position_m"][:2]),
                number(_root(covariance[0][0]), 3),
                number(_root(covariance[1][1]), 3),
                number(tag["sigma_m"], 3),
                number(tag["shape_sigma_m"], 3),
                str(tag["n_observations"]),
                names_text(tag["runs"]),
            )
        )
    columns = (
        "tag",
        "family",
        "component",
        "x (m)",
        "y (m)",
        "sigma x (m)",
        "sigma y (m)",
        "largest (m)",
        "relative to tags (m)",
        "observations",
        "runs",
    )
    frame = frame_name(document["components"][0]) if len(document["components"]) == 1 else "the component's frame"
    note = (
        f"Sigmas relative to {frame}, the largest along the worst direction; and that relative to the other tags, "
        "without shift and turn of all together. tags.csv has both in x and y."
    )
    return table_of("tags", "Tags", note, columns, rows, tag_targets(document))


def _root(variance: float | None) -> float | None:
    return None if variance is None else max(variance, 0.0) ** 0.5
