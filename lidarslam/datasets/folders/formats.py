"""Readers of scan files into tables of points, by their suffix."""

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.state.npy import read_array
from lidarslam.datasets.folders.pcd import read_pcd
from lidarslam.datasets.folders.ply import read_ply
from lidarslam.datasets.folders.scan_files import KITTI_FIELDS, read_bin, read_bytes

TableReader = Callable[[Path], NDArray[np.void]]

# Fields of the float32 numbers of a .bin point, by how many there are; in the order of preference.
_BIN_FIELDS = {5: (*KITTI_FIELDS, "ring"), 4: KITTI_FIELDS, 3: ("x", "y", "z")}
_MOST_RINGS = 256
_WIDEST_ARRAY = 16


def table_reader(files: Sequence[Path]) -> TableReader:
    """The reader for scan files, all with one suffix.

    Raises:
        InputError: the number of values a point of a `.bin` file is ambiguous.
    """
    suffix = files[0].suffix.lower()
    if suffix == ".bin":
        fields = _BIN_FIELDS[_bin_columns(files)]
        return lambda path: _as_table(read_bin(path, len(fields)), fields)
    return {".pcd": read_pcd, ".ply": read_ply, ".npy": read_npy}[suffix]


def _bin_columns(files: Sequence[Path]) -> int:
    """How many numbers a point has: so that the sizes of most files fit, since the file itself does not say.

    Four fit almost always where they are right; five, as nuScenes has them, only count where the fifth number is a
    small integer in every point.
    """
    sizes = np.array([path.stat().st_size if path.exists() else 0 for path in files])
    fits = {columns: int(np.count_nonzero(sizes % (4 * columns) == 0)) for columns in _BIN_FIELDS}
    if fits[5] and not _fifth_is_ring(files[int(np.argmax(sizes * (sizes % 20 == 0)))]):
        fits[5] = 0
    columns = max(fits, key=lambda columns: fits[columns])
    if not fits[columns]:
        raise InputError(
            f"{files[0]}: expected float32 points of x, y, z, intensity, 16 bytes each, or of 12 bytes, or of 20 bytes"
            f" with a ring, got {sizes[0]} bytes, which fit none; copy it again, or convert the scans to .npy or .ply"
        )
    return columns


def _fifth_is_ring(path: Path) -> bool:
    fifth = read_bin(path, 5)[:, 4]
    return bool(len(fifth) and ((fifth >= 0) & (fifth < _MOST_RINGS) & (fifth == np.floor(fifth))).all())


def read_npy(path: Path) -> NDArray[np.void]:
    """The points (N,) of a .npy file: a structured array with fields, or (N, >=3) numbers that begin with x, y, z.

    Four columns are x, y, z and intensity. Organised arrays are flattened.

    Raises:
        InputError: the file is damaged or holds another array.
    """
    data = read_bytes(path)
    try:
        array = read_array(BytesIO(data))
    except Exception as error:  # NumPy parses the header as Python, which fails in many ways
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: cannot be read as .npy ({reason}); it is truncated or damaged: copy it again or remove it"
        ) from None
    if array.dtype.names:
        return cast("NDArray[np.void]", array.reshape(-1))
    if array.ndim < 2 or not 3 <= array.shape[-1] <= _WIDEST_ARRAY or array.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: expected an array (N, 3) or wider of numbers that begin with x, y, z, or a structured array,"
            f" got {array.shape} of {array.dtype}"
        )
    further = tuple(f"column_{column}" for column in range(3, array.shape[-1]))
    names = KITTI_FIELDS if len(further) == 1 else (*"xyz", *further)
    return _as_table(array.reshape(-1, array.shape[-1]), names)


def _as_table(numbers: NDArray[np.generic], names: tuple[str, ...]) -> NDArray[np.void]:
    """An array (N, columns) of one type as a structured array (N,) with these names."""
    dtype = np.dtype([(name, numbers.dtype) for name in names])
    return np.ascontiguousarray(numbers).view(dtype).reshape(-1)
