"""Settings of the range images that scans become; light, so that reading a configuration imports no torch."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from odometry.images.normal_config import NormalConfig


class ImageConfig(BaseModel):
    """How a scan becomes an image; the columns go round once, the rows span the sensor's elevations."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rows: int = Field(16, ge=4, le=256)
    columns: int = Field(720, ge=64, le=4096)
    order: Literal["elevation", "ring"] = Field(
        "elevation",
        description="what a row is: an elevation or a laser, which alignment takes as evenly spaced in elevation",
    )
    normals: NormalConfig = NormalConfig()
