"""Settings of the maps; light, so that reading a configuration imports no Open3D."""

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class GlobalMapConfig(BaseModel):
    """The merged map that a run leaves behind."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    voxel_size_m: float | None = Field(
        None, gt=0.0, description="one point a voxel; null: follows the median range of the first scan"
    )
    min_range_m: float = Field(0.5, ge=0.0, description="nearer points, mostly the carrier itself, are left out")
    max_range_m: float = Field(80.0, gt=0.0, description="farther points, sparse and noisy, are left out")
    min_hits: int = Field(1, ge=1, description="scans' points a voxel needs before it is written")
    normal_neighbours: int = Field(20, ge=3, description="points that a normal is estimated from")

    @model_validator(mode="after")
    def _ranges_leave_something(self) -> Self:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(
                f"min_range_m={self.min_range_m:g} must be less than max_range_m={self.max_range_m:g},"
                " or no point is left"
            )
        return self


class MappingConfig(BaseModel):
    """Scan-to-map refinement."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    enabled: bool = Field(False, description="correct the odometry against the local map")
