"""Where the network that comes with the program lies; without torch."""

from importlib.resources import files
from pathlib import Path

from lidarslam.core.errors import ConfigError

_NAME = "correlation"


def default_weights() -> Path:
    """The file of weights, for training and for accelerators.

    Raises:
        ConfigError: it came without.
    """
    path = _folder() / f"{_NAME}.safetensors"
    return _required(path, path.is_file())


def shipped_folder() -> Path:
    """The folder of the same network as ONNX, for inference.

    Raises:
        ConfigError: it came without.
    """
    path = _folder() / _NAME
    return _required(path, path.is_dir())


def _folder() -> Path:
    return Path(str(files("odometry"))) / "weights"


def _required(path: Path, is_there: bool) -> Path:
    if not is_there:
        raise ConfigError(
            f"{path}: the weights that come with the program are missing;"
            " install it again, or name a file of weights with --weights FILE"
        )
    return path
