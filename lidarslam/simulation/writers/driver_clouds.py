"""The points of a sweep as each sensor's driver lays them out: names, types, units and padding."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarslam.simulation.choices import choose
from lidarslam.simulation.recorder import SimulatedScan

Records = NDArray[np.void]
_FIRST_RETURN = 0x10


@dataclass(frozen=True)
class DriverCloud:
    """A driver's topic and point layout."""

    topic: str  # the driver's defaults
    frame_id: str
    record: np.dtype[np.void]  # type of a point, padding included
    columns: Callable[[SimulatedScan, int], dict[str, ArrayLike]]  # beside x, y, z, by the sweep and its stamp_ns
    imu_topic: str = "/imu/data"  # of the IMU in the sensor, or of one beside it
    imu_frame_id: str = "imu_link"
    custom_message: bool = False  # Livox's own rather than PointCloud2

    def records(self, simulated: SimulatedScan, stamp_ns: int) -> Records:
        """The points (N,) of a sweep whose message is stamped `stamp_ns`."""
        records = np.zeros(len(simulated.scan), self.record)
        for column, axis in enumerate("xyz"):
            records[axis] = simulated.scan.points[:, column]
        for name, values in self.columns(simulated, stamp_ns).items():
            records[name] = values
        return records


def find_driver(name: str) -> DriverCloud:
    """The layout of a driver."""
    return choose("driver", name, DRIVERS)


def _offsets(simulated: SimulatedScan) -> NDArray[np.float64]:
    offsets = simulated.scan.time_offsets
    return np.zeros(len(simulated.scan)) if offsets is None else offsets


def _rings(simulated: SimulatedScan) -> ArrayLike:
    return 0 if simulated.scan.rings is None else simulated.scan.rings


# Intensities are whole numbers from 0 to 255, the scale of all four drivers.
def _velodyne(simulated: SimulatedScan, stamp_ns: int) -> dict[str, ArrayLike]:  # noqa: ARG001
    return {"intensity": simulated.intensities, "ring": _rings(simulated), "time": _offsets(simulated)}


def _ouster(simulated: SimulatedScan, stamp_ns: int) -> dict[str, ArrayLike]:  # noqa: ARG001
    return {  # `ambient`, sunlight, stays zero: the simulated night is dark
        "intensity": simulated.intensities,
        "t": np.round(1e9 * _offsets(simulated)),
        "reflectivity": simulated.intensities,
        "ring": _rings(simulated),
        "range": np.round(1e3 * np.linalg.norm(simulated.scan.points, axis=1)),
    }


def _hesai(simulated: SimulatedScan, stamp_ns: int) -> dict[str, ArrayLike]:
    timestamps = stamp_ns / 10**9 + _offsets(simulated)
    return {"intensity": simulated.intensities, "ring": _rings(simulated), "timestamp": timestamps}


def _livox(simulated: SimulatedScan, stamp_ns: int) -> dict[str, ArrayLike]:  # noqa: ARG001
    return {
        "offset_time": np.round(1e9 * _offsets(simulated)),
        "reflectivity": simulated.intensities,
        "tag": _FIRST_RETURN,
        "line": _rings(simulated),
    }


_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
# velodyne_pointcloud, PointXYZIRT: packed
_VELODYNE_POINT = np.dtype([*_XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
# ouster-ros, point type "original": laid out by PCL, which keeps 16 bytes for the coordinates
_OUSTER_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u2", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    }
)
# HesaiLidar_ROS_2.0: packed
_HESAI_POINT = np.dtype([*_XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("timestamp", "<f8")])
# livox_ros_driver2, CustomPoint: 19 bytes
_LIVOX_POINT = np.dtype([("offset_time", "<u4"), *_XYZ, ("reflectivity", "|u1"), ("tag", "|u1"), ("line", "|u1")])

DRIVERS: dict[str, DriverCloud] = {
    "velodyne": DriverCloud("/velodyne_points", "velodyne", _VELODYNE_POINT, _velodyne),
    "ouster": DriverCloud("/ouster/points", "os_lidar", _OUSTER_POINT, _ouster, "/ouster/imu", "os_imu"),
    "hesai": DriverCloud("/lidar_points", "hesai_lidar", _HESAI_POINT, _hesai),
    "livox": DriverCloud("/livox/lidar", "livox_frame", _LIVOX_POINT, _livox, "/livox/imu", "livox_imu", True),
}
