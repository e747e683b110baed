"""Settings of training; light, so that reading a configuration imports no torch."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from typing_extensions import Self

from odometry.images.image_config import ImageConfig
from odometry.network.network_config import NetworkConfig
from odometry.training.loss_config import LossConfig

Teacher = Literal["alignment", "map"]
Precision = Literal["32-true", "bf16-mixed", "16-mixed"]

# The least that DeLORA's network can look at.
_DELORA_ROWS = 16


class AugmentationConfig(BaseModel):
    """Augmentation of pairs; probabilities unless said otherwise. See `odometry.training.pairs`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    max_gap: int = Field(
        10, ge=1, description="steps from one scan of a pair to the other, 1 to this many, small ones more often"
    )
    reverse: float = Field(0.5, ge=0.0, le=1.0, description="the later scan comes first")
    heading: float = Field(1.0, ge=0.0, le=1.0, description="both scans are turned about z by the same angle, any")
    roll: float = Field(0.8, ge=0.0, le=1.0, description="the current scan is turned about z by whole columns")
    roll_deg: float = Field(12.0, ge=0.0, description="standard deviation of most of these turns")
    any_roll: float = Field(
        0.2, ge=0.0, le=1.0, description="the others, by any angle; a part of those that are turned"
    )
    mirror: float = Field(0.5, ge=0.0, le=1.0)
    scale: float = Field(0.3, ge=0.0, lt=1.0, description="both scans grow or shrink by up to this part")
    drop_beams: float = Field(0.3, ge=0.0, le=1.0, description="up to half of the rows are emptied")
    drop_points: float = Field(0.2, ge=0.0, lt=1.0, description="up to this part of the points, of each scan anew")
    hide_sector: float = Field(0.2, ge=0.0, le=1.0, description="up to a quarter of the turn is emptied in one scan")
    range_noise_m: float = Field(0.02, ge=0.0, description="greatest standard deviation of noise on the ranges")
    wet_ground: float = Field(0.15, ge=0.0, le=1.0, description="level ground beyond 5 to 30 m does not return")
    glass: float = Field(0.15, ge=0.0, le=1.0, description="several rectangles of one scan do not return")
    bird_turn_deg: float = Field(
        0.7, ge=0.0, description="standard deviation of the turn by which scans are brought in line seen from above"
    )


class TrainingConfig(BaseModel):
    """What is trained, on what, and for how long; see `odometry.training.training`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    network: NetworkConfig = NetworkConfig()
    images: ImageConfig = ImageConfig()
    augmentation: AugmentationConfig = AugmentationConfig()
    geometric: LossConfig | None = Field(LossConfig(), description="the paper's losses; null: none")
    geometric_weight: float = Field(1.0, ge=0.0)
    geometric_points: int = Field(1024, ge=64, description="points of each scan that are looked up in the other")
    alignment_weight: float = Field(1.0, ge=0.0, description="of the distance to the motion that the teacher finds")
    teacher: Teacher = Field(
        "alignment",
        description="of recordings: alignment of consecutive scans, or the trajectory that mapping without any network"
        " finds where its status is ok; simulated ones are taught by alignment",
    )
    recorded_share: float = Field(
        0.3, gt=0.0, lt=1.0, description="of pairs from recordings, where there are simulated ones beside"
    )
    steps: int = Field(12_000, ge=1)
    batch: int = Field(16, ge=1, description="pairs a step, of each process")
    learning_rate: float = Field(1e-3, gt=0.0)
    warmup_steps: int = Field(300, ge=0)
    weight_decay: float = Field(1e-3, ge=0.0)
    clip_gradient: float = Field(1.0, gt=0.0)
    precision: Precision = "32-true"
    seed: int = Field(0, ge=0)
    hold_out: float = Field(0.1, ge=0.0, lt=1.0, description="part of the recordings that is kept for validation")
    log_every: int = Field(50, ge=1)
    validate_every: int = Field(500, ge=1)

    @model_validator(mode="after")
    def _something_is_minimised(self) -> Self:
        if not self.alignment_weight and (self.geometric is None or not self.geometric_weight):
            raise ValueError("geometric and alignment_weight are both off, which leaves no loss")
        if self.geometric is not None and self.geometric.correspondence == "projection":
            raise ValueError(
                "geometric.correspondence=projection is not for training, where scans are turned and thinned;"
                " take nearest"
            )
        return self

    @model_validator(mode="after")
    def _images_suit_the_network(self) -> Self:
        network, images = self.network.correlation, self.images
        if network.rows != images.rows:
            raise ValueError(f"network.correlation.rows={network.rows} and images.rows={images.rows} must be the same")
        if self.network.name == "delora" and images.rows < _DELORA_ROWS:
            raise ValueError(
                f"images.rows={images.rows} is too few for network.name=delora, which needs {_DELORA_ROWS}"
            )
        if self.network.name == "correlation" and images.columns % 4:
            raise ValueError(f"images.columns={images.columns} must be a multiple of 4 for network.name=correlation")
        return self
