"""Measurement models of a map, and the file that marks its folder. Imports nothing heavy: command lines need both."""

from enum import StrEnum
from typing import Final

JSON_FILE: Final = "map.json"


class MapModel(StrEnum):
    """Measurement model of a component's last solve."""

    FLOOR = "2d"  # positions of tags on the floor
    CORNERS = "corners"  # corners of tags in pixels
