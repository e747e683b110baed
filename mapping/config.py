"""Settings of the maps; light, so that reading a configuration imports no Open3D."""

from pydantic import BaseModel, ConfigDict, Field


class GlobalMapConfig(BaseModel):
    """The merged map that a run leaves behind."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    voxel_size_m: float | None = Field(
        None, gt=0.0, description="one point a voxel; null: follows the median range of the first scan"
    )
    min_range_m: float = Field(0.5, ge=0.0, description="nearer points, mostly the carrier itself, are left out")
    max_range_m: float = Field(80.0, gt=0.0, description="farther points, sparse and noisy, are left out")
    min_hits: int = Field(1, ge=1, description="scans' points a voxel needs before it is written")
    normal_neighbours: int = Field(20, ge=3, description="points that a normal is estimated from")
