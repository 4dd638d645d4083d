"""The root of every error that a user can cause or mend."""


class GroundsbotError(Exception):
    """Something a person can put right: one line that names file, field, value, limit and way out."""


class CalibError(GroundsbotError):
    """A calibration or robot file that cannot be used."""
