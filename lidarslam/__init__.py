"""LiDAR SLAM: trajectories and maps of recorded runs and in a program's own loop, and how good they are.

The names below are loaded when they are first used; `docs/python.md` shows them in use.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lidarslam.api.recordings import OpenRecording, evaluate, open
    from lidarslam.api.slam import Slam
    from lidarslam.config.settings import Config
    from lidarslam.core.errors import LidarSlamError
    from lidarslam.core.scan import Scan
    from lidarslam.core.tracking import Status
    from lidarslam.core.trajectory import Trajectory
    from lidarslam.mapping.global_map.point_cloud import PointCloud
    from lidarslam.pipeline.estimates import ScanEstimate as RegisteredScan

    __version__: str

__all__ = [
    "Config",
    "LidarSlamError",
    "OpenRecording",
    "PointCloud",
    "RegisteredScan",
    "Scan",
    "Slam",
    "Status",
    "Trajectory",
    "evaluate",
    "open",
]

_MODULES = {
    "Config": "lidarslam.config.settings",
    "LidarSlamError": "lidarslam.core.errors",
    "OpenRecording": "lidarslam.api.recordings",
    "PointCloud": "lidarslam.mapping.global_map.point_cloud",
    "RegisteredScan": "lidarslam.pipeline.estimates:ScanEstimate",
    "Scan": "lidarslam.core.scan",
    "Slam": "lidarslam.api.slam",
    "Status": "lidarslam.core.tracking",
    "Trajectory": "lidarslam.core.trajectory",
    "evaluate": "lidarslam.api.recordings",
    "open": "lidarslam.api.recordings",
}

if not TYPE_CHECKING:  # a type checker would take any name for one of these

    def __getattr__(name):
        if name == "__version__":
            from importlib.metadata import version

            return version("lidarslam")
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        module, _, renamed = _MODULES[name].partition(":")
        value = globals()[name] = getattr(import_module(module), renamed or name)
        return value

    def __dir__():
        return sorted({*globals(), *__all__})
