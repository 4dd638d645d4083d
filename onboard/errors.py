"""Errors of the recorder and of logs."""

from groundsbot.calib.errors import GroundsbotError


class OnboardError(GroundsbotError):
    """A device, a configuration or a log that cannot be used."""


class LogError(OnboardError):
    """A log file that cannot be read or written."""


class MessageRefusedError(LogError):
    """A message that cannot be written to a log; the log itself stays valid."""
