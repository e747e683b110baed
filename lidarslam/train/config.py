"""The configuration of a training; light, so that reading it imports no torch."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field

from lidarslam.config.settings import dump_yaml, load_model
from lidarslam.datasets.config import ReaderConfig
from lidarslam.train.directory import SOURCES_SECTION
from odometry.training.loss_config import LossConfig
from odometry.training.training_config import TrainingConfig

LossName = Literal["both", "point-to-plane", "plane-to-plane", "paper", "alignment"]
LOSSES: tuple[str, ...] = get_args(LossName)

_GEOMETRIC: dict[str, LossConfig] = {
    "both": LossConfig(),
    "point-to-plane": LossConfig(plane_to_plane=False),
    "plane-to-plane": LossConfig(point_to_plane=False),
    "paper": LossConfig.paper(),
}


class SimulatedConfig(BaseModel):
    """Recordings that are simulated for the training, of the worlds, sensors and carriers of the mixture."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    recordings: int = Field(0, ge=0)
    scans: int = Field(60, ge=2, description="of each")
    seed: int = Field(0, ge=0)
    worlds: tuple[str, ...] | None = Field(None, description="of those recordings, only the ones in these; null: all")
    sensors: tuple[str, ...] | None = Field(None, description="and only the ones of these; null: all")


class TrainConfig(BaseModel):
    """Everything that decides what a training computes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    training: TrainingConfig = TrainingConfig()
    reader: ReaderConfig = ReaderConfig()
    simulated: SimulatedConfig = SimulatedConfig()


def load_train_config(path: Path | None = None, settings: Sequence[str] = ()) -> TrainConfig:
    """The defaults, changed by a YAML file and then by settings such as `training.batch=8`.

    Raises:
        ConfigError: the file is not readable YAML, a key does not exist, or a value does not fit.
    """
    return load_model(TrainConfig, path, settings, "training.batch=8")


def dump_train_yaml(config: TrainConfig, trained_on: dict[str, Any]) -> str:
    """The configuration as YAML, after the section that says what is trained on."""
    return dump_yaml(config, trained_on, SOURCES_SECTION)


def loss_settings(name: str | None) -> list[str]:
    """What `--losses` stands for, as settings."""
    if name is None:
        return []
    if name == "alignment":
        return ["training.geometric=null", "training.alignment_weight=1.0"]
    geometric = json.dumps(_GEOMETRIC[name].model_dump(mode="json"))
    return [f"training.geometric={geometric}", "training.alignment_weight=0.0"]
