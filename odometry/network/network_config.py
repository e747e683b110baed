"""Settings of the networks; light, so that reading a configuration imports no torch."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

NetworkName = Literal["correlation", "delora"]


class CorrelationConfig(BaseModel):
    """The size of the default network; see `odometry.network.correlation`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rows: int = Field(16, ge=4, multiple_of=4, description="of the images")
    widths: tuple[int, int, int] = Field((16, 24, 32), description="channels of the three stages of the column encoder")
    bird_width: int = Field(16, ge=1, description="channels of the bird's-eye encoder")
    bird_features: int = Field(8, ge=1, description="that are correlated over shifts")


class NetworkConfig(BaseModel):
    """Which network looks at two scans."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: NetworkName = "correlation"
    correlation: CorrelationConfig = CorrelationConfig()
