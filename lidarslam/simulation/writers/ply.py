"""A folder of binary PLY files, one a scan, with the time and the ring of every point."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.simulation.recording.recorder import SimulatedScan
from lidarslam.simulation.writers.clock import clock_s
from lidarslam.simulation.writers.interface import Rig

_PROPERTY_TYPES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<u2": "ushort", "<u4": "uint"}


def write_ply_scans(folder: Path, scans: Iterable[SimulatedScan], rig: Rig) -> None:  # noqa: ARG001
    """Write scan_000000.ply and so on, and timestamps.txt; implements `Writer`."""
    folder.mkdir()
    with (folder / "timestamps.txt").open("w", encoding="utf-8") as stamps:
        for number, simulated in enumerate(scans):
            write_ply(folder / f"scan_{number:06d}.ply", _vertices(simulated))
            stamps.write(f"{clock_s(simulated.scan.stamp):.9f}\n")


def write_ply(path: Path, vertices: NDArray[np.void]) -> None:
    """Write a structured array (N,) as the vertices of a binary little-endian PLY file, its fields as they are named.

    Raises:
        KeyError: a field is not little-endian float32, float64, uint8, uint16 or uint32.
    """
    names = vertices.dtype.names or ()
    properties = [f"property {_PROPERTY_TYPES[vertices.dtype[name].str]} {name}\n" for name in names]
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{''.join(properties)}end_header\n"
    with path.open("wb") as out:
        out.write(header.encode("ascii"))
        out.write(vertices.tobytes())


def _vertices(simulated: SimulatedScan) -> NDArray[np.void]:
    scan = simulated.scan
    columns: dict[str, tuple[str, NDArray[np.generic]]] = {
        **{axis: ("<f4", scan.points[:, column]) for column, axis in enumerate("xyz")},
        "intensity": ("<f4", simulated.intensities),
    }
    if scan.time_offsets is not None:
        columns["t"] = ("<u4", np.round(1e9 * scan.time_offsets))
    if scan.rings is not None:
        columns["ring"] = ("<u2", scan.rings)
    vertices = np.empty(len(scan), np.dtype([(name, kind) for name, (kind, _) in columns.items()]))
    for name, (_, values) in columns.items():
        vertices[name] = values
    return vertices
