"""The report's tables, from the document that map.json is written from."""

from collections.abc import Iterable, Sequence
from itertools import combinations
from math import degrees
from typing import Any, Final, NamedTuple

from offline.report_words import (
    advice_sentence,
    check_contradicts,
    has_several_families,
    largest_sigma_m,
    linking_tags,
    tag_label,
)

_MOST_ROWS: Final = 1000
_UNKNOWN: Final = "\N{EN DASH}"
# Fewer shared tags tell no transform.
_LEAST_SHARED: Final = 2


class Table(NamedTuple):
    """A table and what it is about; `more` rows were left out."""

    key: str  # names it in the page
    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    more: int = 0


def tables(document: dict[str, Any]) -> list[Table]:
    """Those that hold something."""
    made = [
        _suspects(document),
        _advice(document),
        _alignments(document),
        _holding(document),
        _start_to_start(document),
        _checks(document),
        _metres(document),
        _measurements(document),
        _runs(document),
        _tags(document),
        _noise(document),
        _calibration(document),
        _choices(document),
    ]
    return [table for table in made if table.rows]


def essential_tags(document: dict[str, Any], component: int) -> list[dict[str, Any]]:
    """Linking tags without any one of which the runs would fall apart, were runs joined by two shared tags each."""
    links = linking_tags(document, component)
    names = document["components"][component]["runs"]
    if not _hang_together(names, links):
        return []
    return [tag for tag in links if not _hang_together(names, [other for other in links if other is not tag])]


def _hang_together(names: Sequence[str], links: Sequence[dict[str, Any]]) -> bool:
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


def _table(key: str, title: str, note: str, columns: Iterable[str], rows: Sequence[Sequence[str]]) -> Table:
    kept = tuple(tuple(row) for row in rows[:_MOST_ROWS])
    return Table(key, title, note, tuple(columns), kept, len(rows) - len(kept))


def _suspects(document: dict[str, Any]) -> Table:
    rows = [
        (str(each["tag_id"]), each["family"], each["kind"], ", ".join(each["runs"]), each["evidence"])
        for each in document["suspect_tags"]
    ]
    note = "Tags that do not belong, each with what speaks against it."
    return _table("suspects", "Suspect tags", note, ("tag", "family", "kind", "runs", "evidence"), rows)


def _advice(document: dict[str, Any]) -> Table:
    several = has_several_families(document)
    rows = [
        (
            str(each["component"] + 1),
            advice_sentence(each, several_families=several),
            _number(each["sigma_m"], 3),
            _number(each["sigma_then_m"], 3),
        )
        for each in document["advice"]
    ]
    note = "What would lower the largest sigma of a tag most, foretold from the covariances; drawn into the map."
    columns = ("component", "what", "largest sigma (m)", "and then (m)")
    return _table("advice", "What to do next", note, columns, rows)


def _alignments(document: dict[str, Any]) -> Table:
    rows = []
    for each in document["alignments"]:
        x_m, y_m, theta_rad = each["transform"]
        rows.append(
            (
                each["from"],
                each["to"],
                f"{each['n_inliers']} of {each['n_shared']}",
                _number(each["inlier_rmse_m"], 2),
                f"{x_m:.2f}, {y_m:.2f}",
                f"{degrees(theta_rad):.1f}",
                ", ".join(str(tag["tag_id"]) for tag in each["outliers"]),
                _sureness(each),
            )
        )
    columns = ("run", "joined with", "shared tags that fit", "RMS (m)", "x, y (m)", "turned (deg)", "left out", "sure")
    note = "How each run's own map lies in another's, by the tags that both hold."
    return _table("alignments", "How the runs fit together", note, columns, rows)


def _sureness(alignment: dict[str, Any]) -> str:
    if not alignment["is_sure"]:
        return f"no; {len(alignment['rivals'])} other ways"
    if not alignment["is_weak"]:
        return "yes"
    x_m, y_m, theta_rad = (alignment["covariance"][i][i] ** 0.5 for i in range(3))
    return f"weak: one tag; to {x_m:.2f} m, {y_m:.2f} m, {degrees(theta_rad):.2f} deg"


def _holding(document: dict[str, Any]) -> Table:
    several = has_several_families(document)
    rows = []
    for component in range(len(document["components"])):
        essential = essential_tags(document, component)
        for tag in linking_tags(document, component):
            is_essential = any(tag is other for other in essential)
            rows.append(
                (
                    tag_label(tag, several_families=several),
                    str(len(tag["runs"])),
                    ", ".join(tag["runs"]),
                    str(tag["n_observations"]),
                    _number(largest_sigma_m(tag["covariance"]), 3),
                    "yes" if is_essential else "no",
                )
            )
    columns = ("tag", "runs", "read by", "readings", "sigma (m)", "runs fall apart without it")
    note = "The tags that more than one run read."
    return _table("holding", "Tags that hold the runs together", note, columns, rows)


def _start_to_start(document: dict[str, Any]) -> Table:
    rows = [
        (each["a"], each["b"], _number(each["distance_m"], 3), _number(each["sigma_m"], 3))
        for each in document["start_to_start"]
    ]
    columns = ("from the start of", "to the start of", "distance (m)", "sigma (m)")
    return _table("starts", "Start to start", "", columns, rows)


def _checks(document: dict[str, Any]) -> Table:
    names = {"scale": "length of a metre", "turn": "a full turn"}
    rows = [
        (
            names[each["name"]],
            each["robot_id"],
            each["batch"] or "",
            f"{100.0 * each['value']:+.2f}",
            f"{100.0 * each['sigma']:.2f}",
            f"{100.0 * each['prior_sigma']:.2f}",
            _number(each["sigmas"], 1),
            "contradict each other" if check_contradicts(each) else "agree",
        )
        for each in document["checks"]
    ]
    columns = (
        "of",
        "robot",
        "tags",
        "differ by (%)",
        "sigma (%)",
        "robot.yaml allows (%)",
        "sigmas",
        "wheels and tags",
    )
    return _table(
        "checks", "Wheels held against tags", "By the readings alone, without what robot.yaml says.", columns, rows
    )


def _metres(document: dict[str, Any]) -> Table:
    kinds = ("wheels", "track", "tags", "mount", "distances", "starts")
    rows = [
        (
            str(each["component"] + 1),
            _number(None if each["sigma"] is None else 100.0 * each["sigma"], 2),
            *(f"{100.0 * each['shares'].get(kind, 0.0):.0f}" for kind in kinds),
        )
        for each in document["metres"]
    ]
    columns = ("component", "sigma (%)", *(f"{kind} (%)" for kind in kinds))
    note = "Everything could be stretched together without a reading noticing; this is what resists, and its share."
    return _table("metres", "What holds the length of a metre", note, columns, rows)


def _measurements(document: dict[str, Any]) -> Table:
    rows = [
        (
            each["kind"],
            each["a"],
            each["b"],
            _list(each["measured"]),
            _list(each["sigma"]),
            _list(each["in_map"]),
            _number(each["off_sigmas"], 1),
            "contradicts the rest" if each["contradicts"] else "",
        )
        for each in document["measurements"]
    ]
    columns = ("kind", "a", "b", "measured", "sigma", "in the map", "off by (sigmas)", "")
    note = "Metres, and radians for the heading of a start."
    return _table("measurements", "Measured by hand", note, columns, rows)


def _runs(document: dict[str, Any]) -> Table:
    rows = []
    for run in document["runs"]:
        x_m, y_m, theta_rad = run["T_map_start"]
        n_tags = sum(run["run"] in tag["runs"] for tag in document["tags"])
        rows.append(
            (
                run["run"],
                run["robot"],
                str(run["component"] + 1),
                str(run["n_keyframes"]),
                _number(run["distance_m"], 1),
                str(n_tags),
                f"{x_m:.2f}, {y_m:.2f}",
                f"{degrees(theta_rad):.1f}",
                run["log"],
            )
        )
    columns = ("run", "robot", "component", "keyframes", "driven (m)", "tags", "start x, y (m)", "heading (deg)", "log")
    return _table("runs", "Runs", "", columns, rows)


def _tags(document: dict[str, Any]) -> Table:
    rows = []
    for tag in document["tags"]:
        covariance = tag["covariance"]
        rows.append(
            (
                f"{tag['tag_id']}{tag['instance']}",
                tag["family"],
                str(tag["component"] + 1),
                *(_number(value, 3) for value in tag["position_m"][:2]),
                _number(_root(covariance[0][0]), 3),
                _number(_root(covariance[1][1]), 3),
                _number(largest_sigma_m(covariance), 3),
                str(tag["n_observations"]),
                ", ".join(tag["runs"]),
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
        "largest sigma (m)",
        "readings",
        "runs",
    )
    note = "Sigmas are of the place as seen from the frame's start; the largest is along the worst direction."
    return _table("tags", "Tags", note, columns, rows)


def _noise(document: dict[str, Any]) -> Table:
    fit = document.get("noise_fit")
    fitted = {each["name"]: each for each in (fit["parameters"] if fit else [])}
    rows = []
    for name, value in document["noise"].items():
        entry = fitted.get(name)
        interval = ""
        if entry is not None and entry["low"] is not None and entry["high"] is not None:
            interval = f"{entry['low']:.3g} to {entry['high']:.3g}"
        if name in ("sigma_tilt_rad", "sigma_height_m"):
            told = "of the floor, by corners"
        elif fit is None:
            told = "given"
        else:
            told = "fitted" if interval else (entry or {}).get("kept") or "not needed"
        rows.append((name, f"{value:.4g}", interval, told))
    note = (
        f"Fitted to what the readings of {', '.join(fit['runs'])} leave over."
        if fit and fit["runs"]
        else "The sigmas that the map was made with."
    )
    return _table("noise", "Noise of wheels and readings", note, ("sigma", "value", "99 % within", "where from"), rows)


def _calibration(document: dict[str, Any]) -> Table:
    rows = [
        (
            each["owner"],
            each["name"],
            str(each["component"] + 1),
            _correction(each["value"], signed=True),
            _correction(each["sigma"]),
            _correction(each["prior_sigma"]),
        )
        for each in document["calibration"]
    ]
    columns = ("of", "correction", "component", "value", "sigma", "sigma before")
    note = "What the map corrects of robot.yaml: scales as a share, the mount in metres and radians."
    return _table("calibration", "Calibration", note, columns, rows)


def _choices(document: dict[str, Any]) -> Table:
    rows = [
        (
            each["owner"],
            each["name"],
            _correction(each["value"], signed=True),
            _correction(each["sigma"]),
            _correction(each["prior_sigma"]),
            "freed" if each["is_freed"] else each["reason"],
        )
        for each in document["choices"]
    ]
    columns = ("of", "correction", "by the drives", "sigma", "sigma in robot.yaml", "freed, or why not")
    note = "What stretches of the drives, each on its own, tell of each number, and what self-calibration made of that."
    return _table("choices", "Self-calibration", note, columns, rows)


def _correction(value: float | None, *, signed: bool = False) -> str:
    return _UNKNOWN if value is None else f"{value:{'+' if signed else ''}.5f}"


def _root(variance: float | None) -> float | None:
    return None if variance is None else max(variance, 0.0) ** 0.5


def _number(value: float | None, digits: int) -> str:
    return _UNKNOWN if value is None else f"{value:.{digits}f}"


def _list(values: Sequence[float | None] | None) -> str:
    return _UNKNOWN if values is None else ", ".join(_number(value, 3) for value in values)
