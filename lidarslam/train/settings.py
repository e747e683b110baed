"""The configuration of a training, composed of the libraries' own; light, so that reading it imports no torch."""

from collections.abc import Sequence
from pathlib import Path

from lidarslam.config.settings import load_model
from lidarslam.core.settings import Settings
from lidarslam.datasets.config import ReaderConfig
from lidarslam.odometry.config import SimulatedConfig, TrainingConfig

# The settings that `--losses` stands for.
LOSSES = {
    "both": ("training.geometric={}", "training.alignment_weight=0"),
    "point-to-plane": ("training.geometric={plane_to_plane: false}", "training.alignment_weight=0"),
    "plane-to-plane": ("training.geometric={point_to_plane: false}", "training.alignment_weight=0"),
    "paper": ("training.geometric={robust: false}", "training.alignment_weight=0"),
    "alignment": ("training.geometric=null", "training.alignment_weight=1"),
}


class TrainConfig(Settings):
    """Everything that determines the results of a training."""

    training: TrainingConfig = TrainingConfig()
    reader: ReaderConfig = ReaderConfig()
    simulated: SimulatedConfig = SimulatedConfig()


def load_train_config(path: Path | None = None, settings: Sequence[str] = ()) -> TrainConfig:
    """The defaults, changed by a YAML file and then by settings such as `training.batch=8`.

    ConfigError where the file is not readable YAML, a key does not exist, or a value does not fit.
    """
    return load_model(TrainConfig, path, settings, "training.batch=8")
