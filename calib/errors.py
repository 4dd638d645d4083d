"""Root of the errors that a user can cause or correct."""


class GroundsbotError(Exception):
    """An error that a user can correct. Its message is one line with file, field, value, limit and way out."""


class CalibError(GroundsbotError):
    """A calibration or robot file, or an address, that cannot be used."""
