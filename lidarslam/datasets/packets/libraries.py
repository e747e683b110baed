"""Libraries that decode packets; none is part of the base installation."""

from importlib import import_module

from lidarslam.core.errors import ConfigError

# What to type. ouster-sdk is no extra: it demands a version of rosbags that this program cannot use, and does not
# need it for what is used here.
_INSTALL = {
    "velodyne_decoder": "pip install 'lidarslam[velodyne]'",
    "ouster.sdk": "pip install --no-deps ouster-sdk",
}


def require(library: str, purpose: str) -> None:
    """Check that a library is installed; the message names the purpose.

    Raises:
        ConfigError: it is not.
    """
    try:
        import_module(library)
    except ModuleNotFoundError as error:
        name = library.partition(".")[0] if error.name and library.startswith(error.name) else error.name
        raise ConfigError(f"{name} is not installed, which {purpose} need; {_INSTALL[library]}") from error
