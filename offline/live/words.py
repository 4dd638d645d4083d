"""A map of drives under way in words: one line an update, and what is missing in it."""

from collections.abc import Sequence
from typing import Any, Final

from groundsbot.calib.foundation import plural
from groundsbot.offline.live.drives import State
from groundsbot.offline.live.live_map import Update
from groundsbot.offline.maps import Component, MapResult
from groundsbot.offline.report import key_figures, next_step, would_help

_NEEDED: Final = 2  # shared tags that join two components
_STATES: Final[tuple[State, ...]] = ("under way", "finished", "away", "waiting")


def update_line(update: Update, document: dict[str, Any] | None, seconds: float, period_s: float) -> str:
    """Return the map in one line.

    Args:
        update: what is known now.
        document: its map, from `map_as_json`; None before anything can be mapped.
        seconds: how long the update took.
        period_s: intended time between updates.
    """
    counts = {state: sum(run.state == state for run in update.runs) for state in _STATES}
    runs = ", ".join(f"{n} {state}" for state, n in counts.items() if n)
    took = f"{seconds:.2f} s" + ("" if seconds <= period_s else f", longer than the period of {period_s:g} s")
    if document is None:
        return f"{runs}: no map yet; {took}"
    driven_m = sum(run["distance_m"] for run in document["runs"])
    n_components = len(document["components"])
    joined = "in one map" if n_components == 1 else f"in {n_components} components"
    shape = next(each.value for each in key_figures(document) if each.name == "shape")
    return f"{runs}, {driven_m:.0f} m: {plural(len(document['tags']), 'tag')} {joined}, shape {shape}; {took}"


def hints(update: Update, document: dict[str, Any] | None) -> list[str]:
    """Return which runs are missing and why, what would join components, and what else to do while driving.

    Args:
        update: what is known now.
        document: its map, from `map_as_json`; None before anything can be mapped.
    """
    found = [
        run.reason if run.reason.startswith(f"{run.name}:") else f"{run.name}: {run.reason}"
        for run in update.runs
        if run.reason
    ]
    if update.trouble:
        found.append(f"warning: {update.trouble}")
    if update.result is None or document is None:
        return found
    missing = missing_joins(update.result)
    # What hardly helps need not be said during the drive.
    is_idle = not document["suspect_tags"] and not any(would_help(each) for each in document["advice"][:1])
    step = "" if missing or is_idle else next_step(document)
    return [*found, *missing, *([f"advice: {step}"] if step else [])]


def missing_joins(result: MapResult) -> list[str]:
    """Return for each component but the first what would join it to the one that it shares most tags with."""
    components = result.components
    return [
        _missing_join(component, [*components[:index], *components[index + 1 :]], index + 1, result.warnings)
        for index, component in enumerate(components)
        if index
    ]


def _missing_join(component: Component, others: Sequence[Component], number: int, warnings: Sequence[str]) -> str:
    own = _ids(component)
    other = max(others, key=lambda each: len(own & _ids(each)))
    here, there = (each.runs[0].run for each in (component, other))
    there = "another part of it" if there == here else there
    n_shared = len(own & _ids(other))
    if n_shared < _NEEDED:
        n_missing = _NEEDED - n_shared
        seen = plural(n_shared, "tag") if n_shared else "no tag"
        more = f"{n_missing} more joins them" if n_shared else f"{n_missing} join them"
        return f"{here} has observed {seen} of {there}: {more}"
    prefix = f"component {number}: "
    why = next((each.removeprefix(prefix) for each in warnings if each.startswith(prefix)), "")
    return why or f"{here} has observed {plural(n_shared, 'tag')} of {there}, which do not join them yet"


def _ids(component: Component) -> set[tuple[str, int]]:
    return {(tag.family, tag.tag_id) for tag in component.tags}
