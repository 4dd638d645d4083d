"""Sections of robot.yaml that the recorder uses: its devices and its options."""

from typing import Annotated, Literal

from pydantic import Field

from groundsbot.calib.robot.fields import NotNegative, Positive, Section, TagFamily
from groundsbot.calib.web import PageText

DetectorName = Literal["pupil-apriltags", "pyapriltags"]


class EncoderDevice(Section):
    """The port of the wheel controller, and its settings."""

    encoder_port: Annotated[str, Field(min_length=1)] | None = None
    encoder_baud: Annotated[int, Field(gt=0)] = 115200
    encoder_rate_hz: Positive = Field(100.0, exclude_if=lambda rate_hz: rate_hz == 100.0)


class CameraDevice(Section):
    """The device of a camera, and its settings."""

    camera: Annotated[str, Field(min_length=1)] | None = None
    camera_fps: Positive = 15.0
    camera_exposure_s: Positive | None = None
    camera_gain: NotNegative | None = None


class Devices(CameraDevice, EncoderDevice):
    """Devices that the recorder opens, and their settings."""


class RecorderOptions(Section):
    """Options of the recorder."""

    picture_rate_hz: NotNegative = 0.0
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 90
    detector: DetectorName = "pupil-apriltags"
    quad_decimate: Annotated[float, Field(ge=1.0, le=8.0)] = 2.0
    detector_threads: Annotated[int, Field(ge=1, le=16)] = Field(1, exclude_if=lambda threads: threads == 1)
    families: Annotated[list[TagFamily], Field(min_length=1)] = Field(["tag36h11"])
    segment_s: Annotated[float, Field(ge=1.0, allow_inf_nan=False)] = 600.0
    segment_mb: Annotated[int, Field(ge=1)] = 500
    keep_free_mb: Annotated[int, Field(ge=0)] = 500
    remove_old_pictures: bool = False
    # None: nothing is served there
    page: PageText | None = Field(None, exclude_if=lambda page: page is None)
    foxglove: PageText | None = Field(None, exclude_if=lambda page: page is None)
