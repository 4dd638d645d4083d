"""Measurement models of a map. Imports nothing heavy: the command line offers the choice."""

from enum import StrEnum


class MapModel(StrEnum):
    """Measurement model of a component's last solve."""

    FLOOR = "2d"  # positions of tags on the floor
    CORNERS = "corners"  # corners of tags in pixels
