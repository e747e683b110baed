"""Settings of the features that are taken out of a scan."""

from pydantic import BaseModel, ConfigDict, Field


class FeatureConfig(BaseModel):
    """Which points of a scan are edges and which are planes; the thresholds are LOAM's where it has them."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    edge_curvature_m2: float = Field(0.1, gt=0.0, description="points that bend more than this are edges")
    plane_curvature_m2: float = Field(0.1, gt=0.0, description="points that bend less than this are planes")
    edge_over_noise: float = Field(
        4.5, ge=0.0, description="an edge bends so many standard deviations more than the noise around it would"
    )
    sectors: int = Field(6, ge=1, description="parts of a ring that each have their own quota")
    sharp_per_sector: int = Field(2, ge=0, description="edges a sector that count as sharp")
    edges_per_sector: int = Field(20, ge=0, description="edges a sector, the sharp ones among them")
    flat_per_sector: int = Field(4, ge=0, description="planes a sector that count as flat")
    min_spacing_m: float = Field(
        0.03, ge=0.0, description="where a ring's points are closer together, every second, fourth or eighth serves"
    )
    max_gap_columns: float = Field(5.0, gt=1.0, description="points farther apart along a ring are no neighbours")
    plane_cell_m: float | None = Field(
        None,
        ge=0.0,
        description="one plane a voxel of this size, and in half as much of a ring; 0: all; null: follows the scan",
    )
