"""Settings of training; light, so that reading a configuration imports no torch."""

from typing import Literal, Self

from pydantic import Field, model_validator

from lidarslam.core.settings import Settings
from lidarslam.odometry.config import ImageConfig, NetworkConfig

Teacher = Literal["alignment", "map"]


class LossConfig(Settings):
    """The geometric losses of the paper; see `odometry.training.losses`."""

    point_to_plane: bool = Field(True, description="distances of points from planes")
    plane_to_plane: bool = Field(True, description="differences of normals")
    robust: bool = Field(True, description="outliers are gated and weigh less; false: as in the paper")

    @model_validator(mode="after")
    def _something_is_minimised(self) -> Self:
        if not (self.point_to_plane or self.plane_to_plane):
            raise ValueError("point_to_plane and plane_to_plane are both off, which leaves no loss")
        return self


class TrainingConfig(Settings):
    """Training of a network; see `odometry.training.training`."""

    network: NetworkConfig = NetworkConfig()
    images: ImageConfig = ImageConfig()
    geometric: LossConfig | None = Field(LossConfig(), description="the geometric losses; null: none")
    alignment_weight: float = Field(1.0, ge=0.0, le=1e6, description="of the distance from the pseudo-labels")
    teacher: Teacher = Field(
        "alignment",
        description="pseudo-labels of recordings: alignment of consecutive scans, or mapping without a network",
    )
    steps: int = Field(12_000, ge=1, le=10**9, description="of the optimizer")
    batch: int = Field(16, ge=1, le=10**4, description="pairs a step, of each process")
    learning_rate: float = Field(1e-3, ge=1e-9, le=1.0, description="the highest, after the warm-up")
    warmup_steps: int = Field(300, ge=0, le=10**9, description="in which the learning rate rises")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="of weights, pairs and augmentation")
    hold_out: float = Field(0.1, ge=0.0, le=0.9, description="part of the recordings kept for validation")

    @model_validator(mode="after")
    def _something_is_minimised(self) -> Self:
        if not self.alignment_weight and self.geometric is None:
            raise ValueError("geometric and alignment_weight are both off, which leaves no loss")
        return self


class SimulatedConfig(Settings):
    """Recordings simulated for the training, of worlds, sensors and carriers drawn at random."""

    recordings: int = Field(0, ge=0, le=10**6, description="how many")
    scans: int = Field(60, ge=2, le=10**5, description="of each")
    worlds: tuple[str, ...] | None = Field(None, description="of those recordings, only the ones in these; null: all")
    sensors: tuple[str, ...] | None = Field(None, description="and only the ones of these; null: all")
