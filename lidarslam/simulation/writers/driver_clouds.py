"""The points of a sweep as each sensor's driver lays them out: names, types, units and padding."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.simulation.recording.recorder import SimulatedScan

Records = NDArray[np.void]


@dataclass(frozen=True)
class DriverCloud:
    """How a driver publishes.

    Attributes:
        topic, frame_id: the driver's defaults.
        record: the type of a point, padding included.
        fill: writes what only this driver has, given the records, the sweep and its stamp in nanoseconds.
        custom_message: whether the message is Livox's own rather than PointCloud2.
    """

    topic: str
    frame_id: str
    record: np.dtype[np.void]
    fill: Callable[[Records, SimulatedScan, int], None]
    custom_message: bool = False

    def records(self, simulated: SimulatedScan, stamp_ns: int) -> Records:
        """The points (N,) of a sweep whose message is stamped `stamp_ns`."""
        records = np.zeros(len(simulated.scan), self.record)
        for column, axis in enumerate("xyz"):
            records[axis] = simulated.scan.points[:, column]
        self.fill(records, simulated, stamp_ns)
        return records


def find_driver(name: str) -> DriverCloud:
    """The layout of a driver.

    Raises:
        InputError: there is no such driver.
    """
    if name not in DRIVERS:
        raise InputError(f"no driver is called {name!r}; there are: {', '.join(DRIVERS)}")
    return DRIVERS[name]


def _record(size: int, **fields: tuple[str, int]) -> np.dtype[np.void]:
    """A record of `size` bytes from `name=(type, offset)`."""
    types, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": list(types), "offsets": list(offsets), "itemsize": size})


_XYZ = {"x": ("<f4", 0), "y": ("<f4", 4), "z": ("<f4", 8)}


def _offsets(simulated: SimulatedScan) -> NDArray[np.float64]:
    offsets = simulated.scan.time_offsets
    return np.zeros(len(simulated.scan)) if offsets is None else offsets


def _offsets_ns(simulated: SimulatedScan) -> NDArray[np.float64]:
    return np.round(1e9 * _offsets(simulated))


def _rings(simulated: SimulatedScan) -> NDArray[np.int32]:
    rings = simulated.scan.rings
    return np.zeros(len(simulated.scan), dtype=np.int32) if rings is None else rings


# Intensities are whole numbers from 0 to 255, the scale of all four drivers.
def _fill_velodyne(records: Records, simulated: SimulatedScan, stamp_ns: int) -> None:  # noqa: ARG001
    records["intensity"] = simulated.intensities
    records["ring"] = _rings(simulated)
    records["time"] = _offsets(simulated)


def _fill_ouster(records: Records, simulated: SimulatedScan, stamp_ns: int) -> None:  # noqa: ARG001
    # `ambient`, sunlight, stays zero: the simulated night is dark.
    records["intensity"] = records["reflectivity"] = simulated.intensities
    records["t"] = _offsets_ns(simulated)
    records["ring"] = _rings(simulated)
    records["range"] = np.round(1e3 * np.linalg.norm(simulated.scan.points, axis=1))


def _fill_hesai(records: Records, simulated: SimulatedScan, stamp_ns: int) -> None:
    records["intensity"] = simulated.intensities
    records["ring"] = _rings(simulated)
    records["timestamp"] = stamp_ns / 10**9 + _offsets(simulated)


def _fill_livox(records: Records, simulated: SimulatedScan, stamp_ns: int) -> None:  # noqa: ARG001
    records["offset_time"] = _offsets_ns(simulated)
    records["reflectivity"] = simulated.intensities
    records["tag"] = _FIRST_RETURN
    records["line"] = _rings(simulated)


_FIRST_RETURN = 0x10

DRIVERS: dict[str, DriverCloud] = {
    # velodyne_pointcloud, PointXYZIRT: packed
    "velodyne": DriverCloud(
        "/velodyne_points",
        "velodyne",
        _record(22, **_XYZ, intensity=("<f4", 12), ring=("<u2", 16), time=("<f4", 18)),
        _fill_velodyne,
    ),
    # ouster-ros, point type "original": laid out by PCL, which keeps 16 bytes for the coordinates
    "ouster": DriverCloud(
        "/ouster/points",
        "os_lidar",
        _record(
            48,
            **_XYZ,
            intensity=("<f4", 16),
            t=("<u4", 20),
            reflectivity=("<u2", 24),
            ring=("<u2", 26),
            ambient=("<u2", 28),
            range=("<u4", 32),
        ),
        _fill_ouster,
    ),
    # HesaiLidar_ROS_2.0: packed
    "hesai": DriverCloud(
        "/lidar_points",
        "hesai_lidar",
        _record(26, **_XYZ, intensity=("<f4", 12), ring=("<u2", 16), timestamp=("<f8", 18)),
        _fill_hesai,
    ),
    # livox_ros_driver2, CustomPoint: 19 bytes
    "livox": DriverCloud(
        "/livox/lidar",
        "livox_frame",
        _record(
            19,
            offset_time=("<u4", 0),
            x=("<f4", 4),
            y=("<f4", 8),
            z=("<f4", 12),
            reflectivity=("|u1", 16),
            tag=("|u1", 17),
            line=("|u1", 18),
        ),
        _fill_livox,
        custom_message=True,
    ),
}
