"""Settings of the odometry methods; light, so that reading a configuration imports no method."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from typing_extensions import Self

from lidarslam.core.limits import require_lost_worse, require_range_left
from odometry.methods.learned_config import LearnedConfig

OdometryName = Literal["learned", "kiss-icp", "constant-velocity", "external"]


class KissConfig(BaseModel):
    """KISS-ICP's own parameters; the defaults are its defaults."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    max_range_m: float = Field(100.0, gt=0.0)
    min_range_m: float = Field(0.0, ge=0.0)
    voxel_size_m: float | None = Field(None, gt=0.0, description="null: a hundredth of max_range_m")
    max_points_per_voxel: int = Field(20, ge=1)
    deskew: bool = True
    max_iterations: int = Field(500, ge=1)
    convergence: float = Field(1e-4, gt=0.0)
    threads: int = Field(0, ge=0, description="0: all cores")
    initial_threshold_m: float = Field(2.0, gt=0.0)
    min_motion_m: float = Field(0.1, gt=0.0)
    fixed_threshold_m: float | None = Field(None, gt=0.0, description="switches the adaptive threshold off")

    @model_validator(mode="after")
    def _ranges_leave_something(self) -> Self:
        require_range_left(self.min_range_m, self.max_range_m)
        return self


class ConsistencyConfig(BaseModel):
    """When two consecutive scans are said to fit each other; see `odometry.methods.consistency`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    queries: int = Field(1000, ge=100, description="points of the new scan that are looked up in the previous one")
    gate_ratio: float = Field(0.02, gt=0.0, description="largest residual of an inlier, as a fraction of its range")
    gate_min_m: float = Field(0.10, gt=0.0, description="smallest gate, for points close to the sensor")
    degraded_below: float = Field(0.70, ge=0.0, le=1.0, description="inlier ratio under which a scan is degraded")
    lost_below: float = Field(0.40, ge=0.0, le=1.0, description="inlier ratio under which a scan is lost")

    @model_validator(mode="after")
    def _lost_is_worse_than_degraded(self) -> Self:
        require_lost_worse(self.lost_below, self.degraded_below)
        return self


class OdometryConfig(BaseModel):
    """Which method gives the motion between scans, and how it is set."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    method: OdometryName = "learned"
    learned: LearnedConfig = LearnedConfig()
    kiss_icp: KissConfig = KissConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
