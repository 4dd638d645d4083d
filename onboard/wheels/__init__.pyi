from .intake import WARM_UP_NS, StampedReading, WheelIntake, wheel_message
from .port import EncoderPort, PortLostError
from .protocol import EncoderParser, WheelLine, format_line

__all__ = [
    "WARM_UP_NS",
    "EncoderParser",
    "EncoderPort",
    "PortLostError",
    "StampedReading",
    "WheelIntake",
    "WheelLine",
    "format_line",
    "wheel_message",
]
