"""Points with all their fields as structured arrays, whatever file they come from."""

from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray

# Bytes; no format has a point with so many fields.
_WIDEST_POINT = 1 << 16


def read_ascii_table(body: bytes, dtype: np.dtype[np.void], rows: int) -> NDArray[np.void]:
    """The first `rows` lines of blank-separated numbers as a structured array (rows,).

    Raises:
        ValueError: there are fewer lines, or one does not fit.
    """
    _require_count(rows)
    if rows == 0:
        return np.empty(0, dtype)
    # A line takes a digit and a blank for each number at least; what NumPy is told to expect, it makes room for.
    if dtype.itemsize > _WIDEST_POINT or rows > (len(body) + 1) // 2 or not body.strip():
        raise ValueError(f"expected {rows} points, got {len(body)} bytes of text: it is truncated")
    table = np.loadtxt(BytesIO(body), dtype=dtype, max_rows=rows, ndmin=1, comments=None)
    if len(table) != rows:
        raise ValueError(f"expected {rows} points, got {len(table)}: it is truncated")
    return np.asarray(table)


def read_binary_table(body: bytes, dtype: np.dtype[np.void], rows: int) -> NDArray[np.void]:
    """The first `rows` rows of packed numbers as a structured array (rows,).

    Raises:
        ValueError: there are fewer.
    """
    _require_count(rows)
    if rows == 0:
        return np.empty(0, dtype)
    if len(body) < rows * dtype.itemsize:
        raise ValueError(
            f"expected {rows} points of {dtype.itemsize} bytes, {rows * dtype.itemsize} in all, got {len(body)}:"
            " it is truncated"
        )
    return np.frombuffer(body, dtype, count=rows)


def _require_count(rows: int) -> None:
    if rows < 0:
        raise ValueError(f"expected a number of points, got {rows}")


def as_table(numbers: NDArray[np.generic], names: tuple[str, ...]) -> NDArray[np.void]:
    """An array (N, columns) of one type as a structured array (N,) with these names."""
    dtype = np.dtype([(name, numbers.dtype) for name in names])
    return np.ascontiguousarray(numbers).view(dtype).reshape(-1)


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
