"""Sparse submaps on disk: those of hours of recording would take hundreds of megabytes of memory."""

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from lidarslam.core.state import BlockFile
from lidarslam.mapping.loops.sparse_submap import PIXELS, SparseSubmap

# Submaps that stay in memory, those used last: about 15 MB.
_KEPT = 256


class SubmapFile:
    """Sparse submaps in order, in a file without a name that ends with this object.

    Args:
        directory: where the file lies; None: where temporary files are.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self._blocks = BlockFile(directory)
        self._points: list[int] = []
        self._recent = lru_cache(_KEPT)(self._read)

    def __len__(self) -> int:
        return len(self._points)

    def __getitem__(self, index: int) -> SparseSubmap:
        if not -len(self) <= index < len(self):
            raise IndexError(f"submap {index} of {len(self)}")
        return self._recent(int(index) % len(self))

    def __iter__(self) -> Iterator[SparseSubmap]:
        return (self[index] for index in range(len(self)))

    def append(self, submap: SparseSubmap) -> None:
        """Keep one more.

        Raises:
            OSError: the disk is full.
        """
        record = np.zeros((), _record(len(submap)))
        for name in record.dtype.names or ():
            record[name] = getattr(submap, name)
        self._blocks.write(record.tobytes())
        self._points.append(len(submap))

    def _read(self, index: int) -> SparseSubmap:
        kind = _record(self._points[index])
        record = np.frombuffer(self._blocks.read(index), kind)[0]
        values = {name: record[name] for name in kind.names or ()}
        return SparseSubmap(**values | {name: float(values[name]) for name in ("range_m", "cell_m")})


def _record(points: int) -> np.dtype[np.void]:
    """The attributes of a submap of so many points."""
    return np.dtype([
        ("R_level_lidar", "f8", (3, 3)), ("range_m", "f8"), ("cell_m", "f8"), ("points", "f4", (points, 3)),
        ("axes", "f2", (points, 3)), ("tilt", "f2", (points,)), ("range_image", "f2", PIXELS),
        ("kinds", "u1", (points,)),
    ])  # fmt: skip
