"""Errors of mapping and its commands."""

from groundsbot.calib.errors import GroundsbotError


class OfflineError(GroundsbotError):
    """Input that cannot become a map."""
