"""What a map can be solved on. Imports nothing heavy: the command line offers the choice."""

from enum import StrEnum


class MapModel(StrEnum):
    """What a component was solved on last."""

    FLOOR = "2d"  # places of tags on the floor
    CORNERS = "corners"  # corners of tags in pixels
