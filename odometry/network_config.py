"""Settings of the networks; light, so that reading a configuration imports no torch."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

NetworkName = Literal["correlation", "delora"]


class CorrelationConfig(BaseModel):
    """The size of the default network; see `odometry.correlation`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rows: int = Field(16, ge=4, multiple_of=4, description="of the images")
    widths: tuple[int, int, int] = Field((24, 48, 64), description="channels of the encoder's three stages")
    pair_width: int = Field(64, ge=8, multiple_of=8, description="channels where two scans are compared")
    reach: int = Field(6, ge=1, description="columns of features to either side that are compared")


class NetworkConfig(BaseModel):
    """Which network looks at two scans."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: NetworkName = "correlation"
    correlation: CorrelationConfig = CorrelationConfig()
