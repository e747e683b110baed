"""lidarslam as a pipeline of evalio.

    python -m lidarslam.api.evalio_pipeline run -p lidarslam -d DATASET -o DIR

This is evalio's command line with the pipeline. Where evalio loads with the installed rerun-sdk,
`EVALIO_CUSTOM=lidarslam.api.evalio_pipeline evalio run ...` is the same.
"""

import logging
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import numpy as np
from evalio.pipelines import Pipeline, register_pipeline
from evalio.types import SE3, ImuMeasurement, ImuParams, LidarMeasurement, LidarParams, Point

from lidarslam.api.slam import Slam
from lidarslam.config.settings import CONFIGS, load_config, shipped_files
from lidarslam.core.errors import InputError
from lidarslam.datasets.mounting import transform_of

logger = logging.getLogger(__name__)

_DEFAULTS: dict[str, bool | int | float | str] = {"config": "", "odometry": "", "mapping": ""}


class LidarSlam(Pipeline):
    """`lidarslam.Slam` on the sweeps of a dataset; poses are saved at the sweeps' starts, and the IMU is not used.

    Parameters: `config`, a YAML file or the name of one that comes with the program; `odometry` and `mapping`, as the
    options of `lidarslam run`. Empty ones are the defaults.
    """

    def __init__(self) -> None:
        super().__init__()
        self._parameters = dict(_DEFAULTS)
        self._T_lidar_imu = self._T_upright_recorded = np.eye(4)
        self._slam: Slam | None = None

    @staticmethod
    def name() -> str:
        """Name in `-p`."""
        return "lidarslam"

    @staticmethod
    def version() -> str:
        """That of the program."""
        return version("lidarslam")

    @staticmethod
    def url() -> str:
        """Where it comes from."""
        return "https://github.com/lidarslam/lidarslam"

    @staticmethod
    def default_params() -> dict[str, bool | int | float | str]:
        """The parameters and their defaults."""
        return dict(_DEFAULTS)

    def set_params(self, params: Mapping[str, bool | int | float | str]) -> dict[str, bool | int | float | str]:
        """Take the parameters; unknown ones are returned."""
        self._parameters.update({name: value for name, value in params.items() if name in _DEFAULTS})
        return {name: value for name, value in params.items() if name not in _DEFAULTS}

    def set_imu_params(self, params: ImuParams) -> None:
        """The IMU is not used."""

    def set_lidar_params(self, params: LidarParams) -> None:
        """The sensor's model is not used."""

    def set_imu_T_lidar(self, T: SE3) -> None:
        """Take the extrinsic calibration: evalio compares poses of the IMU."""
        self._T_lidar_imu = np.array(T.inverse().to_mat(), dtype=np.float64)

    def initialize(self) -> None:
        """Build the estimator; LidarSlamError where a parameter does not fit."""
        given = self._parameters
        settings = [f"{name}.method={given[name]}" for name in ("odometry", "mapping") if given[name]]
        config = str(given["config"])
        file = shipped_files(CONFIGS).get(config, Path(config)) if config else None
        loaded = load_config(file, settings)
        self._T_upright_recorded = transform_of(loaded.reader.mounting)
        self._slam = Slam(loaded)

    def add_imu(self, mm: ImuMeasurement) -> None:
        """The IMU is not used."""

    def add_lidar(self, mm: LidarMeasurement) -> None:
        """Register a sweep, and save its pose; one that cannot be used has none."""
        assert self._slam is not None
        points = np.array(mm.to_vec_positions(), dtype=np.float64).reshape(-1, 3)
        try:
            scan = self._slam.register_frame(points, np.array(mm.to_vec_stamps()), mm.stamp.to_sec())
        except InputError as error:
            logger.warning("%s", error)
            return
        self.save(mm.stamp, SE3.from_mat(scan.T_world_lidar @ self._T_upright_recorded @ self._T_lidar_imu))

    def map(self) -> dict[str, list[Point]]:
        """No map is shown."""
        return {}


def main() -> None:
    """Run evalio's command line, without Rerun: evalio 0.6.1 fails to load rerun-sdk 0.41."""
    sys.modules["rerun"] = None  # type: ignore[assignment]
    register_pipeline(LidarSlam)  # before the command line, which lists the pipelines when it is loaded
    from evalio.cli import app

    app()


if __name__ == "__main__":
    main()
