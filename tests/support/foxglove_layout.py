"""Layouts of Foxglove and Lichtblick."""

from typing import Any


def panels_in(layout: Any) -> set[str]:
    """The panels that a layout's division of the window names."""
    return {layout} if isinstance(layout, str) else panels_in(layout["first"]) | panels_in(layout["second"])
