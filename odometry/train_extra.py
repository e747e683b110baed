"""The extra `train`: libraries that training, export and accelerators need, and inference on the CPU does not."""

from importlib import import_module

from lidarslam.core.errors import ConfigError

_LIBRARIES = ("torch", "tensorboard", "safetensors", "onnx", "onnxscript")


def require_train_extra(purpose: str) -> None:
    """Check that the libraries of the extra are installed; the message names the purpose.

    Raises:
        ConfigError: one is missing.
    """
    for name in _LIBRARIES:
        try:
            import_module(name)
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"{error.name} is not installed, which {purpose} needs; pip install 'lidarslam[train]'"
                " (PyTorch's CPU build, installed first, is much smaller: https://pytorch.org/get-started/locally)"
            ) from error
