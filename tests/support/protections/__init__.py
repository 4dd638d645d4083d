"""What protects from each fault of docs/faults.md: a few lines of the program, and how to take them out."""

from typing import Final

from tests.support.protections.devices import DEVICE_PROTECTIONS
from tests.support.protections.gyro import GYRO_PROTECTIONS
from tests.support.protections.logs import LOG_PROTECTIONS
from tests.support.protections.protection import Protection

__all__ = ["PROTECTIONS", "Protection"]

PROTECTIONS: Final = (*LOG_PROTECTIONS, *DEVICE_PROTECTIONS, *GYRO_PROTECTIONS)
