"""Settings of the learned odometry; light, so that reading a configuration imports no torch."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from odometry.alignment_config import AlignmentConfig


class LearnedConfig(BaseModel):
    """Which weights are used, and how the network's answers are refined and judged; see `odometry.learned`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    weights: Path | None = Field(
        None, description="a .safetensors file of `lidarslam train`; null: those that come along"
    )
    device: str = Field("cpu", min_length=1, description="torch's name of the device, such as cpu or cuda")
    threads: int = Field(1, ge=1, description="of torch; mapping works beside it")
    bfloat16: bool = Field(False, description="encode with half the digits, where the device is faster so")
    alignment: AlignmentConfig = AlignmentConfig(column_step=3)
    doubtful_share: float = Field(
        0.6, ge=0.0, le=1.0, description="of the points that fit; below, going on as before is tried too"
    )
    clearly_better: float = Field(0.1, ge=0.0, le=1.0, description="by which that must fit more points")
    least_share: float = Field(0.25, ge=0.0, le=1.0, description="below, the motion is not believed")
    least_points: int = Field(60, ge=6, description="below, the motion is not believed")
