"""Fields of points in a structured array, whatever file it comes from."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray


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
