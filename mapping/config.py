"""Settings of the maps; light, so that reading a configuration imports no Open3D."""

import math
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BeforeValidator, Field, field_validator, model_validator

from lidarslam.core.plugins import PlugPoint
from lidarslam.core.settings import RangeSettings, Settings

MappingName = Literal["surfels", "loam", "off"]
MAPPINGS = PlugPoint("mapping", get_args(MappingName))
MapField = Literal["intensity", "rgb", "ring", "time"]
"""An attribute of the points of a map."""
MapFormat = Literal["pcd", "laz", "e57"]
"""Formats of a map besides .ply."""
BudgetMs = Annotated[float, Field(ge=1.0, le=1e6)] | Literal["auto"] | None
"""Milliseconds that a scan may take; auto: half of the time between scans; None: not bounded."""


class TrackingConfig(Settings):
    """Inlier ratios that a registered scan needs; see `mapping.tracking.mapped_scan`."""

    degraded_below: float = Field(0.6, ge=0.0, le=1.0, description="inlier ratio below which a scan is degraded")
    lost_below: float = Field(0.45, ge=0.0, le=1.0, description="inlier ratio below which a scan is lost")

    @model_validator(mode="after")
    def _lost_is_worse_than_degraded(self) -> Self:
        if self.lost_below > self.degraded_below:
            raise ValueError(
                f"lost_below={self.lost_below:g} must not exceed degraded_below={self.degraded_below:g},"
                " as a lost scan is worse than a degraded one"
            )
        return self


class MappingConfig(RangeSettings):
    """Scan-to-map registration."""

    method: Annotated[str, BeforeValidator(MAPPINGS.check)] = Field(
        "surfels",
        description="surfels (without rings: LOAM's planes), loam (LOAM's mapping), off (the odometry alone), or"
        " another package's",
    )
    cell_m: float | None = Field(
        None, ge=0.02, le=10.0, description="edge of the finest cells, LOAM's spacing; null: 1/30 of the median range"
    )
    radius_m: float = Field(100.0, ge=1.0, le=10_000.0, description="radius of the local map around the sensor")
    min_range_m: float = Field(
        0.5, ge=0.0, le=10_000.0, description="nearer points, mostly the carrier itself, are ignored"
    )
    max_range_m: float = Field(100.0, ge=1.0, le=10_000.0, description="farther points are ignored")
    keypoints: int = Field(
        3000, ge=100, le=10**6, description="maximum number of registered points per scan (LOAM: of planar ones)"
    )
    continuous_time: bool = Field(True, description="estimate the velocity during the sweep together with its pose")
    prior_rotation_deg: float = Field(
        3.0,
        ge=0.01,
        le=180.0,
        description="standard deviation of the odometry's rotation about each axis, where it has no covariance",
    )
    prior_translation_m: float = Field(
        0.15,
        ge=1e-3,
        le=100.0,
        description="standard deviation of the odometry's translation along each axis, where it has no covariance",
    )
    budget_ms: BudgetMs = Field(
        None,
        description="time of a scan after which no further attempt begins, and searches go on with the"
        " next scan; auto: half of the time between scans; null: no limit (live: auto)",
    )
    tracking: TrackingConfig = TrackingConfig()

    @property
    def enabled(self) -> bool:
        """Whether scans are registered to a map."""
        return self.method != "off"

    @field_validator("method", mode="before")
    @classmethod
    def _off_is_a_word(cls, value: Any) -> Any:
        """YAML parses `off` as false."""
        return "off" if value is False else value


class GlobalMapConfig(RangeSettings):
    """The merged map of a run."""

    voxel_size_m: float | None = Field(
        None,
        ge=0.01,
        le=10.0,
        description="one point per voxel; null: 1/50 of the first scan's median range, 0.05 to 0.25",
    )
    min_range_m: float = Field(
        0.5, ge=0.0, le=10_000.0, description="nearer points, mostly the carrier itself, are ignored"
    )
    max_range_m: float = Field(80.0, ge=1.0, le=10_000.0, description="farther points, sparse and noisy, are ignored")
    leave_out_moved: bool = Field(
        True, description="remove points that other scans see through: people and vehicles that passed"
    )
    most_points: int | None = Field(
        20_000_000,
        ge=1000,
        le=10**9,
        description="a larger map lies on disk, is written in tiles, map/, and map.ply is thinned to so many points;"
        " null: any number",
    )
    fields: tuple[MapField, ...] = Field(
        ("intensity", "rgb"),
        description="point attributes of the map, where scans have them: intensity, rgb, ring, time",
    )


class KeyframeConfig(Settings):
    """When a scan becomes a keyframe; see `mapping.pose_graph.keyframe_graph`."""

    distance_m: float | None = Field(
        None,
        ge=0.1,
        le=100.0,
        description="distance between keyframes; null: a quarter of the median range, 0.5 to 4 m",
    )
    turn_deg: float = Field(25.0, ge=1.0, le=180.0, description="rotation between keyframes")


class LoopConfig(Settings):
    """Loop detection and verification; see `mapping.loops.detection`."""

    max_range_m: float = Field(60.0, ge=1.0, le=10_000.0, description="farther points of a keyframe are ignored")
    drift_percent: float = Field(
        1.0,
        ge=0.01,
        le=100.0,
        description="standard deviation of the drift, per distance; 1 % also means 2 degrees of attitude per 100 m",
    )
    min_way_m: float | None = Field(
        None,
        ge=0.0,
        le=1e6,
        description="least distance travelled between two visits; null: three median ranges, at least 10 m",
    )
    min_overlap: float = Field(0.75, ge=0.0, le=1.0, description="least inlier ratio where two keyframes overlap")

    @property
    def drift_rates(self) -> tuple[float, float]:
        """Standard deviations of attitude and position per metre travelled, radians and metres."""
        return math.radians(0.02 * self.drift_percent), 0.01 * self.drift_percent


class PoseGraphConfig(Settings):
    """Keyframes, loop closures and their optimisation; see `mapping.pose_graph.slam_graph`."""

    enabled: bool = Field(False, description="build a pose graph, close loops, and correct trajectory and map")
    corrects_local_map: bool = Field(True, description="surfels only: rebuild the local map after a loop closure")
    gnss: bool = Field(False, description="add the recording's GNSS positions as factors; `run` only")
    keyframes: KeyframeConfig = KeyframeConfig()
    loops: LoopConfig = LoopConfig()

    @model_validator(mode="after")
    def _gnss_has_a_graph(self) -> Self:
        if self.gnss and not self.enabled:
            raise ValueError("gnss needs enabled: true")
        return self
