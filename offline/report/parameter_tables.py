"""The report's tables of what numbers the map rests on: robot.yaml, noise, and what was measured by hand."""

from typing import Any

from groundsbot.offline.report.cells import ReportTable, number, numbers, table_of
from groundsbot.offline.report.sentences import check_contradicts


def checks(document: dict[str, Any]) -> ReportTable:
    """Wheels and tags."""
    names = {"scale": "length of a metre", "turn": "a full turn"}
    rows = [
        (
            names[each["name"]],
            each["robot_id"],
            each["batch"] or "",
            f"{100.0 * each['value']:+.2f}",
            f"{100.0 * each['sigma']:.2f}",
            f"{100.0 * each['prior_sigma']:.2f}",
            number(each["sigmas"], 1),
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
    return table_of(
        "checks", "Wheels held against tags", "By the readings alone, without what robot.yaml says.", columns, rows
    )


def scale_table(document: dict[str, Any]) -> ReportTable:
    """Components, and what each one's metre comes from."""
    kinds = ("wheels", "track", "tags", "mount", "distances", "starts")
    rows = [
        (
            str(each["component"] + 1),
            number(None if each["sigma"] is None else 100.0 * each["sigma"], 2),
            *(f"{100.0 * each['shares'].get(kind, 0.0):.0f}" for kind in kinds),
        )
        for each in document["metres"]
    ]
    columns = ("component", "sigma (%)", *(f"{kind} (%)" for kind in kinds))
    note = "Everything could be stretched together without a reading noticing; this is what resists, and its share."
    return table_of("metres", "What holds the length of a metre", note, columns, rows)


def measurements(document: dict[str, Any]) -> ReportTable:
    """What somebody measured."""
    rows = [
        (
            each["kind"],
            each["a"],
            each["b"],
            numbers(each["measured"]),
            numbers(each["sigma"]),
            numbers(each["in_map"]),
            number(each["off_sigmas"], 1),
            "contradicts the rest" if each["contradicts"] else "",
        )
        for each in document["measurements"]
    ]
    columns = ("kind", "a", "b", "measured", "sigma", "in the map", "off by (sigmas)", "")
    note = "Metres, and radians for the heading of a start."
    return table_of("measurements", "Measured by hand", note, columns, rows)


def noise(document: dict[str, Any]) -> ReportTable:
    """Sigmas of wheels and readings."""
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
    return table_of(
        "noise", "Noise of wheels and readings", note, ("sigma", "value", "99 % within", "where from"), rows
    )


def robots(document: dict[str, Any]) -> ReportTable:
    """What the drives say of robots' files."""
    rows = [
        (
            each["owner"],
            each["what"],
            number(each["in_file"], 4),
            number(each["found"], 4),
            number(each["sigma"], 4),
            each["verdict"],
            each["to_do"],
        )
        for each in document["robot_numbers"]
    ]
    columns = ("of", "number", "robot.yaml", "found", "sigma", "verdict", "what to do")
    note = "Each number of a robot's file, and as the map of these drives has it. Metres, seconds, radians."
    return table_of("robots", "What these drives say of the robots", note, columns, rows)
