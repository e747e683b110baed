"""Settings of keyframes, loops and the pose graph; light, so that reading a configuration imports no GTSAM."""

from pydantic import BaseModel, ConfigDict, Field

from mapping.loops.loop_config import LoopConfig
from mapping.pose_graph.pose_graph_config import PoseGraphConfig


class KeyframeConfig(BaseModel):
    """When a scan becomes a keyframe; see `mapping.pose_graph.keyframes`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    distance_m: float | None = Field(
        None, gt=0.0, description="way from one to the next; null: a quarter of the median range, 0.5 to 4 m"
    )
    turn_deg: float = Field(25.0, gt=0.0, description="turn from one to the next")
    least_overlap: float = Field(
        0.5, ge=0.0, le=1.0, description="share of a scan that the last keyframe saw, below which the next is due"
    )


class TrajectoryEdgeConfig(BaseModel):
    """How far the motion from one keyframe to the next is believed, one standard deviation each."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rotation_deg: float = Field(0.03, gt=0.0, description="at least")
    translation_m: float = Field(0.005, gt=0.0, description="at least, along each axis")
    drift_deg_per_m: float = Field(0.02, ge=0.0, description="more for each metre of the way")
    drift_percent: float = Field(0.3, ge=0.0, description="more, of the way")
    unmapped_factor: float = Field(5.0, ge=1.0, description="of all of these for an odometry without a map")
    lost_rotation_deg: float = Field(20.0, gt=0.0, description="where tracking was lost on the way")
    lost_translation_m: float = Field(1.0, gt=0.0, description="likewise")
    odometry_caution: float = Field(
        10.0, gt=0.0, description="factor on the standard deviations that an odometry gives itself: its errors repeat"
    )


class SlamGraphConfig(BaseModel):
    """Whether loops are closed, and how; see `mapping.pose_graph.slam_graph`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    enabled: bool = Field(False, description="build a pose graph, close loops, and correct trajectory and map")
    keyframes: KeyframeConfig = KeyframeConfig()
    edges: TrajectoryEdgeConfig = TrajectoryEdgeConfig()
    loops: LoopConfig = LoopConfig()
    optimiser: PoseGraphConfig = PoseGraphConfig()
