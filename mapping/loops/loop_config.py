"""Settings of loop closures; light, so that reading a configuration imports no SciPy."""

import math

from pydantic import BaseModel, ConfigDict, Field, model_validator
from typing_extensions import Self

from lidarslam.core.limits import require_range_left


class LoopConfig(BaseModel):
    """How places seen before are found again, and when a closure is believed; see `mapping.loops.detection`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min_range_m: float = Field(0.5, ge=0.0, description="nearer points, mostly the carrier itself, are left out")
    max_range_m: float = Field(60.0, gt=0.0, description="farther points are left out")
    max_points: int = Field(2500, ge=200, description="points of a keyframe that are kept for registration, at most")
    cells_per_range: float = Field(30.0, gt=0.0, description="how many cells, the unit of most gates, make the range")
    radius_m: float | None = Field(
        None, gt=0.0, description="how far places are compared; null: four times the first keyframe's median range"
    )
    drift_percent: float = Field(1.0, gt=0.0, description="standard deviation of the estimate, of the way between")
    drift_deg_per_100m: float = Field(2.0, gt=0.0, description="likewise in attitude")
    max_drift_sigmas: float = Field(3.0, gt=0.0, description="larger corrections within a session are not believed")
    max_drift_sigmas_by_appearance: float = Field(
        2.0, gt=0.0, description="likewise of places that were found by how they look, wherever they are"
    )
    min_way_m: float = Field(10.0, ge=0.0, description="shorter ways back are no loops")
    min_way_ranges: float = Field(3.0, ge=0.0, description="likewise, in median ranges of the scene")
    spacing_m: float = Field(2.0, ge=0.0, description="way after a closure before the next is looked for")
    nearby_candidates: int = Field(2, ge=0, description="places near the estimate that a keyframe is laid on, at most")
    appearance_candidates: int = Field(2, ge=0, description="likewise, places that look alike, wherever they are")
    min_similarity: float = Field(0.35, ge=-1.0, le=1.0, description="of places that are said to look alike")
    neighbours: int = Field(2, ge=0, description="keyframes on either side whose points help in the registration")
    min_overlap: float = Field(0.75, ge=0.0, le=1.0, description="share of what each sees of the other that fits")
    min_explained: float = Field(0.55, ge=0.0, le=1.0, description="the same of what tells the worst direction")
    min_inlier_ratio: float = Field(0.2, ge=0.0, le=1.0, description="share of all points of a keyframe that fit")
    min_inliers: int = Field(150, ge=12, description="fewer points that fit do not make a closure")
    max_sigma_m: float = Field(0.25, gt=0.0, description="closures that tell a direction of translation less are none")
    max_sigma_deg: float = Field(2.0, gt=0.0, description="likewise for rotation")
    agreeing: int = Field(2, ge=0, description="other closures that must agree with one that no estimate supports")
    alone_ranges: float = Field(
        0.5, ge=0.0, description="a closure nearby is believed alone while drift is less than so many median ranges"
    )
    agreeing_span_ranges: float = Field(
        1.0, ge=0.0, description="way that agreeing closures must be spread over, in median ranges"
    )
    pending_m: float = Field(100.0, gt=0.0, description="way after which a closure that nothing agrees with is dropped")

    @property
    def drift_rates(self) -> tuple[float, float]:
        """Standard deviations of the estimate's attitude and position for each metre of the way, radians and metres."""
        return math.radians(self.drift_deg_per_100m) / 100.0, 0.01 * self.drift_percent

    @model_validator(mode="after")
    def _ranges_leave_something(self) -> Self:
        require_range_left(self.min_range_m, self.max_range_m)
        return self
