"""Types of the fields of robot.yaml, and the base of its sections."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
# No length on a robot is that large; a larger number was given in millimetres.
Length = Annotated[float, Field(gt=0.0, le=10.0, allow_inf_nan=False)]
Place = Annotated[float, Field(ge=-10.0, le=10.0, allow_inf_nan=False)]
ModulePlace = Annotated[list[Place], Field(min_length=2, max_length=2)]
TagFamily = Literal["tag36h11", "tag25h9", "tag16h5"]


class Section(BaseModel):
    """Section of robot.yaml: all fields are known and of their own types."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)
