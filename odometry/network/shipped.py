"""The network that comes with the program; without torch."""

from importlib.resources import files
from pathlib import Path

from lidarslam.core.errors import ConfigError


def default_weights() -> Path:
    """The file of weights, for training and for accelerators.

    Raises:
        ConfigError: it came without.
    """
    return _required("correlation.safetensors")


def shipped_folder() -> Path:
    """The folder of the same network as ONNX, for inference; errors likewise."""
    return _required("correlation")


def _required(name: str) -> Path:
    path = Path(str(files("lidarslam.odometry"))) / "weights" / name
    if not path.exists():
        raise ConfigError(
            f"{path}: the weights that come with the program are missing;"
            " install it again, or name a file of weights with --weights FILE"
        )
    return path
