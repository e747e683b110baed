"""The network bundled with the program, and the libraries that its training needs; without torch."""

from importlib import import_module
from importlib.resources import files
from pathlib import Path

from lidarslam.core.errors import ConfigError


def default_weights() -> Path:
    """The file of weights, for training and for accelerators.

    ConfigError where the program was installed without it.
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


_LIBRARIES = ("torch", "tensorboard", "safetensors", "onnx", "onnxscript")


def require_train_extra(purpose: str) -> None:
    """Check that the libraries of the extra are installed; the message names the purpose.

    ConfigError where one is missing.
    """
    for name in _LIBRARIES:
        try:
            import_module(name)
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"{error.name} is not installed, which {purpose} needs; pip install 'lidarslam[train]'"
                " (PyTorch's CPU build, installed first, is much smaller: https://pytorch.org/get-started/locally)"
            ) from error
