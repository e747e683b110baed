"""Settings of the geometric loss; light, so that reading a configuration imports no torch."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from typing_extensions import Self


class LossConfig(BaseModel):
    """What the predicted motion is held against; see `odometry.training.losses`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    point_to_plane: bool = True
    plane_to_plane: bool = True
    point_to_plane_weight: float = Field(1.0, gt=0.0, description="lambda of the paper")
    gate_m: float | None = Field(
        1.0, gt=0.0, description="points farther from their correspondence are left out; null: none is"
    )
    robust_m: float | None = Field(
        0.1,
        gt=0.0,
        description="point-to-plane distance at which Huber's kernel goes from square to line; null: square",
    )
    plane_norm: Literal["squared", "linear"] = Field(
        "squared", description="the length of the difference of the normals, squared or as it is"
    )
    symmetric: bool = Field(False, description="also match the previous scan against the current one, and average")
    correspondence: Literal["nearest", "projection"] = Field(
        "nearest", description="the nearest point in space, or the point of the pixel that is projected onto"
    )
    candidates: Literal["with_normal", "all"] = Field(
        "with_normal",
        description="search among the points with a normal, or among all, leaving out who finds one without a normal",
    )

    @model_validator(mode="after")
    def _something_is_minimised(self) -> Self:
        if not (self.point_to_plane or self.plane_to_plane):
            raise ValueError("point_to_plane and plane_to_plane are both off, which leaves no loss")
        return self

    @classmethod
    def paper(cls) -> "LossConfig":
        """The settings of DeLORA (ICRA 2021): every pair counts, and counts squared."""
        return cls(gate_m=None, robust_m=None, candidates="all")
