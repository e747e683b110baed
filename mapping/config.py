"""Settings of the maps; light, so that reading a configuration imports no Open3D."""

from pydantic import BaseModel, ConfigDict, Field, model_validator
from typing_extensions import Self

from lidarslam.core.limits import require_lost_worse, require_range_left


class GlobalMapConfig(BaseModel):
    """The merged map that a run leaves behind."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    voxel_size_m: float | None = Field(
        None, gt=0.0, description="one point a voxel; null: follows the median range of the first scan"
    )
    min_range_m: float = Field(0.5, ge=0.0, description="nearer points, mostly the carrier itself, are left out")
    max_range_m: float = Field(80.0, gt=0.0, description="farther points, sparse and noisy, are left out")
    min_hits: int = Field(1, ge=1, description="scans' points a voxel needs before it is written")
    leave_out_moved: bool = Field(
        True, description="leave out what other scans saw through where it was: people and vehicles that passed"
    )
    normal_neighbours: int = Field(20, ge=3, description="points that a normal is estimated from")

    @model_validator(mode="after")
    def _ranges_leave_something(self) -> Self:
        require_range_left(self.min_range_m, self.max_range_m)
        return self


class RefinementConfig(BaseModel):
    """How a scan is laid on the map; see `mapping.registration`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    max_iterations: int = Field(
        20, ge=1, description="steps, the surfaces looked up anew before each; at least one a size of cells"
    )
    coarse_iterations: int = Field(3, ge=0, description="at most so many of them on each coarser size of cells")
    converged_rotation_deg: float = Field(0.02, gt=0.0, description="smaller steps end the iteration")
    converged_translation_m: float = Field(0.001, gt=0.0, description="likewise")
    min_matches: int = Field(60, ge=12, description="fewer points on surfaces do not make a pose")


class TrackingConfig(BaseModel):
    """When a scan laid on the map is believed; see `mapping.tracking.fit`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    gate_cells: float = Field(0.5, gt=0.0, description="largest distance of an inlier from its surface, in cells")
    gate_ratio: float = Field(0.02, gt=0.0, description="likewise, as a fraction of its range")
    gate_min_m: float = Field(0.05, gt=0.0, description="likewise, the least it can be")
    degraded_below: float = Field(0.6, ge=0.0, le=1.0, description="inlier ratio under which a scan is degraded")
    lost_below: float = Field(0.45, ge=0.0, le=1.0, description="inlier ratio under which a scan is lost")
    degraded_below_support: float = Field(
        0.5, ge=0.0, le=1.0, description="inlier ratio of what constrains the least supported direction, likewise"
    )
    lost_below_support: float = Field(0.35, ge=0.0, le=1.0, description="likewise, under which a scan is lost")
    search_yaw_step_deg: float = Field(15.0, ge=1.0, le=360.0, description="start rotations around gravity when lost")
    give_up_after: int = Field(20, ge=1, description="lost scans in a row after which a new map is begun")

    @model_validator(mode="after")
    def _lost_is_worse_than_degraded(self) -> Self:
        require_lost_worse(self.lost_below, self.degraded_below)
        require_lost_worse(self.lost_below_support, self.degraded_below_support, "_support")
        return self


class MappingConfig(BaseModel):
    """Scan-to-map refinement."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    enabled: bool = Field(True, description="correct the odometry against the local map")
    cell_m: float | None = Field(
        None, ge=0.01, description="edge of the map's finest cells; null: follows the median range of the scene"
    )
    cells_per_range: float = Field(30.0, gt=0.0, description="how many cells make the median range")
    radius_m: float = Field(100.0, gt=0.0, description="the map is forgotten beyond")
    min_range_m: float = Field(0.5, ge=0.0, description="nearer points, mostly the carrier itself, are left out")
    max_range_m: float = Field(100.0, gt=0.0, description="farther points are left out")
    keypoints: int = Field(3000, ge=100, description="points of a scan that are registered, about")
    continuous_time: bool = Field(True, description="estimate the velocity during the sweep together with its pose")
    second_deskew: bool = Field(
        True, description="without continuous time: compensate again with the refined motion where it differs"
    )
    prior_rotation_deg: float = Field(
        3.0, gt=0.0, description="standard deviation of an odometry's rotation, about each axis"
    )
    prior_translation_m: float = Field(
        0.15, gt=0.0, description="standard deviation of an odometry's translation, along each axis"
    )
    prior_caution: float = Field(
        10.0, gt=0.0, description="factor on the standard deviations that an odometry gives itself: its errors repeat"
    )
    refinement: RefinementConfig = RefinementConfig()
    tracking: TrackingConfig = TrackingConfig()

    @model_validator(mode="after")
    def _something_is_registered(self) -> Self:
        require_range_left(self.min_range_m, self.max_range_m)
        if self.refinement.min_matches > self.keypoints:
            raise ValueError(
                f"refinement.min_matches={self.refinement.min_matches} must not be more than"
                f" keypoints={self.keypoints}, or every scan is lost"
            )
        return self
