"""Settings of the learned odometry; light, so that reading a configuration imports no torch."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from odometry.alignment.alignment_config import AlignmentConfig


class LearnedConfig(BaseModel):
    """Which weights are used, and how the network's answers are refined and judged; see `odometry.methods.learned`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    weights: Path | None = Field(
        None,
        description="a .safetensors file of `lidarslam train`, or a folder of `lidarslam export`, which starts faster;"
        " null: those that come along",
    )
    device: str = Field("cpu", min_length=1, description="torch's name of the device, such as cpu or cuda")
    threads: int = Field(1, ge=1, description="of the network; mapping works beside it")
    alignment_rows: int | None = Field(
        None, ge=4, le=256, description="null: as many as the sensor has rings, 16 to 64"
    )
    alignment: AlignmentConfig = AlignmentConfig(column_step=3)
    least_explained: float = Field(
        0.3, ge=0.0, le=1.0, description="of what a scan says that must agree with the last one for it to be believed"
    )
    least_points: int = Field(60, ge=6, description="that must agree")
    changing_rad_s2: float = Field(
        2.0, gt=0.0, description="by which a turn may change, along directions of which the scans say nothing"
    )
    changing_m_s2: float = Field(2.0, gt=0.0, description="and the speed")
