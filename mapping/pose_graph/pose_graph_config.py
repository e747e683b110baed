"""Settings of the pose graph; light, so that reading a configuration imports no GTSAM."""

from pydantic import BaseModel, ConfigDict, Field


class PoseGraphConfig(BaseModel):
    """How a pose graph is optimised; see `mapping.pose_graph.optimizer`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    anchor_rotation_deg: float = Field(0.01, gt=0.0, description="standard deviation of the pose that is held")
    anchor_translation_m: float = Field(0.001, gt=0.0, description="likewise")
    least_rotation_deg: float = Field(0.001, gt=0.0, description="no edge is believed to be more precise than this")
    least_translation_m: float = Field(0.0002, gt=0.0, description="likewise")
    largest_ratio: float = Field(
        1e7, gt=1.0, le=1e7, description="no edge is taken to be more uncertain than this many times the least"
    )
    relinearise_above: float = Field(
        0.1, gt=0.0, description="iSAM2 linearises a pose anew when it moved by more, in radians and metres"
    )
    iterations_after_loop: int = Field(5, ge=0, description="further steps of iSAM2 when a loop was added")
    loop_kernel_sigmas: float = Field(
        4.0, gt=0.0, description="scale of Cauchy's kernel: in iSAM2, loops that are off by more pull less and less"
    )
    loop_limit_sigmas: float = Field(
        6.0, gt=0.0, description="in the end a loop that is off by more standard deviations is not believed"
    )
    convexity_step: float = Field(2.0, gt=1.0, description="factor by which that limit sharpens from step to step")
    max_steps: int = Field(60, ge=1, description="of them, at most")
    max_iterations: int = Field(100, ge=1, description="of Levenberg-Marquardt in each")
