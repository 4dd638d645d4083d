"""The report's tables of parameters: robot.yaml, noise, and external measurements."""

from typing import Any, Final

from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.report.cells import UNKNOWN, ReportTable, number, numbers, table_of
from groundsbot.offline.report.verdict import check_contradicts
from groundsbot.offline.self_calibration import ESTIMATED

_NOISE_NOTE: Final = (
    "Standard deviations of the wheels for each root metre driven or root radian turned, and of single tag "
    "observations. Values that the drives do not determine are kept and need no action; act where a fitted one is "
    "several times its default: look for slipping wheels, blurred pictures and stamps that come late."
)


def checks(document: dict[str, Any]) -> ReportTable:
    """Return the table that compares wheels and tags."""
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
        "prior sigma (%)",
        "sigmas",
        "wheels and tags",
    )
    note = (
        "By the observations alone. The prior sigma of the difference is what robot.yaml leaves open, or what was "
        "assumed for an import without one."
    )
    return table_of("checks", "Wheels compared with tags", note, columns, rows)


def scale_table(document: dict[str, Any]) -> ReportTable:
    """Return the table of what determines each component's scale."""
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
    note = "The share of each source of information on the scale; without them, the whole map could be scaled."
    return table_of("metres", "What determines the scale", note, columns, rows)


def _use(measurement: dict[str, Any]) -> str:
    """Return whether a measurement contradicts the rest, and that no component uses it; empty if all is well."""
    if measurement["component"] is None:
        return "contradicts the rest, so not used" if measurement["contradicts"] else "not used"
    return "contradicts the rest" if measurement["contradicts"] else ""


def measurements(document: dict[str, Any]) -> ReportTable:
    """Return the table of external measurements."""
    rows = [
        (
            each["kind"],
            each["a"],
            each["b"],
            numbers(each["measured"]),
            numbers(each["sigma"]),
            numbers(each["in_map"]),
            number(each["off_sigmas"], 1),
            _use(each),
        )
        for each in document["measurements"]
    ]
    columns = ("kind", "a", "b", "measured", "sigma", "in the map", "off by (sigmas)", "")
    note = "Metres, and radians for the heading of a start."
    return table_of("measurements", "Measured by hand", note, columns, rows)


def noise(document: dict[str, Any]) -> ReportTable:
    """Return the table of sigmas of wheels and observations."""
    fit = document.get("noise_fit")
    fitted = {each["name"]: each for each in (fit["parameters"] if fit else [])}
    defaults = NoiseParameters().model_dump()
    rows = []
    for name, value in document["noise"].items():
        entry = fitted.get(name)
        interval = ""
        if entry is not None and entry["low"] is not None and entry["high"] is not None:
            interval = f"{entry['low']:.3g} to {entry['high']:.3g}"
        if name in ("sigma_tilt_rad", "sigma_height_m"):
            told = "fitted to corners"
        elif fit is None:
            told = "given"
        else:
            told = "fitted" if interval else (entry or {}).get("kept") or "not needed"
        default = f"{defaults[name]:.4g}" if name in defaults else UNKNOWN
        rows.append((name, f"{value:.4g}", interval, default, told))
    source = f"Fitted to the residuals of {', '.join(fit['runs'])}." if fit and fit["runs"] else "Used as given."
    columns = ("sigma", "value", "99 % interval", "default", "source")
    return table_of("noise", "Noise of wheels and observations", f"{source} {_NOISE_NOTE}", columns, rows)


def robots(document: dict[str, Any]) -> ReportTable:
    """Return the table of robots' parameters as estimated from the drives."""
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
    is_open = any(each["verdict"] == ESTIMATED for each in document["robot_numbers"])
    start = "robot.yaml or assumed" if is_open else "robot.yaml"
    columns = ("of", "number", start, "estimate", "sigma", "verdict", "what to do")
    note = "Each number of a robot's file, and its estimate from these drives. Metres, seconds, radians."
    if is_open:
        note += (
            " Numbers that had not been measured, as of imported drives, began at an assumed value with a wide sigma; "
            "every map estimates them anew, and groundsbot-offline calibrate writes them into a robot.yaml to keep."
        )
    return table_of("robots", "Robot parameters estimated from these drives", note, columns, rows)
