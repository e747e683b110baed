"""Tables of points in binary files."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray[np.generic]]
"""The columns (N,) of a table by their names, x among them."""

POINTS_AT_A_TIME = 1_000_000
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint", "i4": "int"}


def write_ply(path: Path, columns: Columns) -> None:
    """Write a table as the vertices of a PLY file."""
    properties = "".join(f"property {_PLY_TYPES[column.dtype.str[1:]]} {name}\n" for name, column in columns.items())
    vertices = f"element vertex {len(columns['x'])}\n{properties}"
    write_table(path, f"ply\nformat binary_little_endian 1.0\n{vertices}end_header\n", columns)


def write_table(path: Path, header: str, columns: Columns) -> None:
    """Write a header, and then row after row, little-endian."""
    dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    count = len(columns["x"])
    with path.open("wb") as out:
        out.write(header.encode("ascii"))
        for first in range(0, count, POINTS_AT_A_TIME):
            table = np.empty(min(POINTS_AT_A_TIME, count - first), dtype=dtype)
            for name, values in columns.items():
                table[name] = values[first : first + len(table)]
            out.write(table.tobytes())
