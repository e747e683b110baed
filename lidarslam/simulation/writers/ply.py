"""A folder of binary PLY files, one a scan, with the time and the ring of every point."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarslam.core.imu import ImuSamples
from lidarslam.datasets.folders.imu_csv import COLUMNS, EXTRINSIC, IMU_FILE
from lidarslam.simulation.recorder import SimulatedScan
from lidarslam.simulation.writers.interface import Rig, clock_s

_PROPERTY_TYPES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<u2": "ushort", "<u4": "uint"}


def write_ply_scans(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:
    """Write scan_000000.ply and so on, timestamps.txt and, with an IMU, imu.csv; implements `Writer`."""
    folder.mkdir()
    if rig.imu is not None:
        write_imu(folder / IMU_FILE, rig.imu)
    with (folder / "timestamps.txt").open("w", encoding="utf-8") as stamps:
        for number, simulated in enumerate(scans):
            scan = simulated.scan
            columns: dict[str, tuple[str, ArrayLike]] = {}
            for axis, coordinates in zip("xyz", scan.points.T, strict=True):
                columns[axis] = ("<f4", coordinates)
            columns["intensity"] = ("<f4", simulated.intensities)
            if scan.time_offsets is not None:
                columns["t"] = ("<u4", np.round(1e9 * scan.time_offsets))
            if scan.rings is not None:
                columns["ring"] = ("<u2", scan.rings)
            write_ply(folder / f"scan_{number:06d}.ply", as_records(columns))
            stamps.write(f"{clock_s(scan.stamp):.9f}\n")


def write_imu(path: Path, imu: ImuSamples) -> None:
    """Write samples, stamped in simulated seconds, as a table on the recording's clock."""
    with path.open("w", encoding="utf-8") as table:
        if imu.T_lidar_imu is not None:
            table.write(f"# {EXTRINSIC}: {' '.join(f'{value:.12g}' for value in imu.T_lidar_imu[:3].ravel())}\n")
        table.write(",".join(COLUMNS) + "\n")
        for stamp, values in zip(imu.stamps, np.hstack([imu.angular_velocities, imu.accelerations]), strict=True):
            table.write(f"{clock_s(stamp):.9f},{','.join(f'{value:.9g}' for value in values)}\n")


def as_records(columns: Mapping[str, tuple[str, ArrayLike]]) -> NDArray[np.void]:
    """A structured array (N,) of columns (N,), each with its type."""
    count = len(np.asarray(next(iter(columns.values()))[1]))
    records = np.empty(count, np.dtype([(name, kind) for name, (kind, _) in columns.items()]))
    for name, (_, values) in columns.items():
        records[name] = values
    return records


def write_ply(path: Path, vertices: NDArray[np.void]) -> None:
    """Write a structured array (N,) as the vertices of a binary little-endian PLY file, its fields as they are named.

    Raises:
        KeyError: a field is not little-endian float32, float64, uint8, uint16 or uint32.
    """
    names = vertices.dtype.names or ()
    properties = [f"property {_PROPERTY_TYPES[vertices.dtype[name].str]} {name}\n" for name in names]
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{''.join(properties)}end_header\n"
    path.write_bytes(header.encode("ascii") + vertices.tobytes())
