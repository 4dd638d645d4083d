"""Errors of mapping and its commands."""

from groundsbot.calib.errors import GroundsbotError


class OfflineError(GroundsbotError):
    """Input that cannot become a map."""


class UnknownNameError(OfflineError, KeyError):
    """A tag or a run that is not in a map, or several that are meant alike."""

    __str__ = Exception.__str__  # a KeyError's own puts the message in quotes
