"""Fields of points in a structured array."""

from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

# Bytes; no format has a point with so many fields.
_WIDEST_POINT = 1 << 16


def read_ascii_table(body: bytes, dtype: np.dtype[np.void], rows: int) -> NDArray[np.void]:
    """The first `rows` lines of blank-separated numbers; ValueError where there are fewer."""
    _require_points(body, rows)
    # A line takes a digit and a blank at least; NumPy makes room for all lines that it is told to expect.
    possible = dtype.itemsize <= _WIDEST_POINT and rows <= (len(body) + 1) // 2 and body.strip()
    table = np.loadtxt(BytesIO(body), dtype=dtype, max_rows=rows, ndmin=1, comments=None) if possible else np.empty(0)
    if len(table) != rows:
        raise ValueError(f"expected {rows} points, got {len(table)} in {len(body)} bytes of text: it is truncated")
    return np.asarray(table, dtype)


def read_binary_table(body: bytes, dtype: np.dtype[np.void], rows: int) -> NDArray[np.void]:
    """The first `rows` rows of packed numbers; ValueError where there are fewer."""
    _require_points(body, rows)
    if len(body) < rows * dtype.itemsize:
        raise ValueError(f"expected {rows} points of {dtype.itemsize} bytes, got {len(body)} bytes: it is truncated")
    return np.frombuffer(body, dtype, count=rows)


def _require_points(body: bytes, rows: int) -> None:
    if not rows and body.strip(b"\0\t\n\r "):
        raise ValueError(f"its header promises no points, and {len(body):,} bytes follow")


def scalar_fields(table: NDArray[np.void]) -> tuple[str, ...]:
    """The names of the fields with one number a point."""
    plain = (name for name in table.dtype.names or () if not table.dtype[name].shape)
    return tuple(name for name in plain if table.dtype[name].kind in "fiu")


def coordinates(table: NDArray[np.void]) -> FloatArray:
    """The fields x, y and z as (N, 3) float64.

    Raises:
        ValueError: a field is missing or is no number.
    """
    names = scalar_fields(table)
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"expected the point fields x, y and z, each one number, got {', '.join(names)}")
    points = np.empty((len(table), 3))
    with np.errstate(invalid="ignore", over="ignore"):  # damaged bytes may be signalling NaN
        for column, name in enumerate("xyz"):
            points[:, column] = table[name]
    return points
