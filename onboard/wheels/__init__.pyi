from .gyro import GyroUnwrapper
from .intake import WARM_UP_NS, StampedGyro, StampedReading, WheelIntake, gyro_message, wheel_message
from .port import EncoderPort, PortLostError
from .protocol import GyroLine, WheelLine, format_gyro_line, format_line

__all__ = [
    "WARM_UP_NS",
    "EncoderPort",
    "GyroLine",
    "GyroUnwrapper",
    "PortLostError",
    "StampedGyro",
    "StampedReading",
    "WheelIntake",
    "WheelLine",
    "format_gyro_line",
    "format_line",
    "gyro_message",
    "wheel_message",
]
