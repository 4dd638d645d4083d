"""Tags and runs of a map by their names."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from groundsbot.offline.errors import UnknownNameError

if TYPE_CHECKING:
    from groundsbot.offline.maps.result import RunResult, TagResult

_MOST_LISTED: Final = 50  # names in an error


def find_tag(tags: Sequence["TagResult"], name: int | str) -> "TagResult":
    """Return the only tag with an id, a label or either with its family.

    Raises:
        UnknownNameError: there is none, or there are several.
    """
    names = [(f"{tag.tag_id}", tag.label, f"{tag.family}:{tag.tag_id}", tag.full_label) for tag in tags]
    found = [tag for tag, own in zip(tags, names, strict=True) if f"{name}" in own]
    if len(found) == 1:
        return found[0]
    if found:
        raise UnknownNameError(
            f"tag {name}: {len(found)} tags fit, {_enumerate([tag.full_label for tag in found])}; name one of them, "
            "and ask its component if they are in several"
        )
    raise UnknownNameError(f"tag {name}: is not in the map, which has {_enumerate([tag.label for tag in tags])}")


def find_run(runs: Sequence["RunResult"], name: str) -> "RunResult":
    """Return the run with a name, or the only one of a robot.

    Raises:
        UnknownNameError: there is none, or there are several.
    """
    found = [run for run in runs if run.name == name] or [run for run in runs if run.robot_id == name]
    if len(found) == 1:
        return found[0]
    names = _enumerate([run.name for run in found or runs])
    if found:
        raise UnknownNameError(f"run {name}: {len(found)} runs fit, {names}; name one of them")
    raise UnknownNameError(f"run {name}: is not in the map, which has {names}")


def _enumerate(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_MOST_LISTED]) or "none"
    return f"{shown} and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else shown
