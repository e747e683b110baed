"""The submaps of keyframes, kept in a file without a name: hours of recording would not fit into memory."""

import tempfile
from pathlib import Path

import numpy as np

from mapping.global_map import VoxelMeans

_COLUMNS = 7


class SubmapStore:
    """Takes submaps one after the other, and gives each back.

    Args:
        directory: where the file lies while it is needed; None: where temporary files do.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self._file = tempfile.TemporaryFile(dir=directory)  # noqa: SIM115 # closed by whoever made the store
        self._ends = [0]  # bytes

    def __len__(self) -> int:
        return len(self._ends) - 1

    def append(self, means: VoxelMeans) -> None:
        """Keep one more.

        Raises:
            OSError: the disk is full.
        """
        rows = np.ascontiguousarray(means.rows, dtype="<f4").tobytes()
        self._file.seek(self._ends[-1])
        self._file.write(rows)
        self._ends.append(self._ends[-1] + len(rows))

    def __getitem__(self, index: int) -> VoxelMeans:
        begin, end = self._ends[index], self._ends[index + 1]
        self._file.seek(begin)
        return VoxelMeans(np.frombuffer(self._file.read(end - begin), dtype="<f4").reshape(-1, _COLUMNS))

    def close(self) -> None:
        """Give the space back."""
        self._file.close()
