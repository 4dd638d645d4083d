from .gyro import GyroReading, GyroUnwrapper
from .intake import WARM_UP_NS, StampedGyro, StampedReading, WheelIntake, gyro_message, wheel_message
from .port import EncoderPort, PortLostError
from .protocol import EncoderParser, GyroLine, Unmeasured, WheelLine, format_gyro_line, format_line

__all__ = [
    "WARM_UP_NS",
    "EncoderParser",
    "EncoderPort",
    "GyroLine",
    "GyroReading",
    "GyroUnwrapper",
    "PortLostError",
    "StampedGyro",
    "StampedReading",
    "Unmeasured",
    "WheelIntake",
    "WheelLine",
    "format_gyro_line",
    "format_line",
    "gyro_message",
    "wheel_message",
]
