"""The odometry methods by name, a method's module being imported when it is chosen, and the bundled network."""

from importlib.resources import files
from pathlib import Path
from typing import cast

from lidarslam.core.errors import ConfigError
from lidarslam.core.plugins import require_library
from lidarslam.core.trajectory import Trajectory
from lidarslam.odometry.config import ODOMETRIES, LearnedConfig, OdometryConfig
from lidarslam.odometry.interface import ConstantVelocity, Odometry


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
    small = "PyTorch's CPU build, installed first, is much smaller: https://pytorch.org/get-started/locally"
    for name in _LIBRARIES:
        require_library(name, f"{purpose} needs", f"pip install 'lidarslam[train]' ({small})")


def make_odometry(config: OdometryConfig, prior: Trajectory | None = None) -> Odometry:
    """The configured method, ready for the first scan.

    The prior is T_odom_lidar, for the method `external` and no other.

    Raises:
        ConfigError: a prior is missing, or given to another method; or the learned odometry's device, its shipped
            weights or the libraries for a file of weights are missing; or another package's cannot be loaded.
        InputError: the learned odometry's weights are invalid.
    """
    if (config.method == "external") != (prior is not None):
        raise ConfigError("a prior trajectory and odometry.method=external go together; give both or neither")
    if prior is not None:
        from lidarslam.odometry.methods.external import ExternalOdometry

        return ExternalOdometry(prior)
    match config.method:
        case "learned" | "learned+imu":
            return _make_learned(config.learned)
        case "kiss-icp":
            from lidarslam.odometry.methods.kiss import KissOdometry

            return KissOdometry(config.kiss_icp)
        case "constant-velocity" | "imu":  # the mapping predicts, by the IMU where there is one
            return ConstantVelocity()
    return cast(Odometry, ODOMETRIES.make(config.method, Odometry))


def _make_learned(config: LearnedConfig) -> Odometry:
    """With ONNX Runtime, which starts at once; with torch for a file of weights, or on an accelerator."""
    from lidarslam.odometry.methods.learned import LearnedOdometry

    if config.device == "cpu" and (config.weights is None or config.weights.is_dir()):
        from lidarslam.odometry.network.exported import load_exported

        search, images = load_exported(config.weights or shipped_folder(), config.threads)
        return LearnedOdometry(search, images, config.alignment)
    require_train_extra(f"odometry.learned.device={config.device}" if config.device != "cpu" else "a file of weights")
    from lidarslam.odometry.network.checkpoint import load_checkpoint, network_of, torch_search

    checkpoint = load_checkpoint(config.weights or default_weights())
    try:
        search = torch_search(network_of(checkpoint), config.device, config.threads)
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts that it has it
        reason = str(error).splitlines()[0]
        raise ConfigError(f"odometry.learned.device={config.device}: torch cannot use it ({reason})") from error
    return LearnedOdometry(search, checkpoint.images, config.alignment)
