"""The submaps of keyframes, kept in a file: hours of recording would not fit into memory."""

import os
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.state import Saved, State
from mapping.global_map.global_map import VoxelMeans

_COLUMNS = 7


class SubmapStore:
    """Takes submaps one after the other, and gives each back.

    Args:
        directory: where a file without a name lies while it is needed; None: where temporary files do.
        file: one with a name instead, that outlives the program.
    """

    def __init__(self, directory: Path | None = None, file: Path | None = None) -> None:
        # Closed by whoever made the store.
        self._file = tempfile.TemporaryFile(dir=directory) if file is None else file.open("w+b")  # noqa: SIM115
        self._path = file
        self._ends = [0]  # bytes
        self._checksums: list[int] = []

    @classmethod
    def restored(cls, saved: Saved, file: Path) -> "SubmapStore":
        """The store with a state, whose submaps lie in a file; what came after the state is cut off.

        Raises:
            InputError: the file is damaged.
            OSError: it cannot be read.
        """
        store = cls.__new__(cls)
        store._file, store._path = file.open("r+b"), file
        store._ends, store._checksums = saved.integers("ends"), saved.integers("checksums")
        if store._ends[:1] != [0] or len(store._ends) != len(store._checksums) + 1:
            raise saved.refuse(f"{len(store._checksums)} submaps end at {store._ends[:2]}, ...")
        store._file.truncate(store._ends[-1])
        for index, checksum in enumerate(store._checksums):
            if zlib.crc32(store._read(index)) != checksum:
                raise InputError(f"{file}: is damaged (submap {index}); begin again with --overwrite")
        return store

    def state(self) -> State:
        """Where submaps end; they are on the disk by now.

        Raises:
            OSError: the disk is full.
        """
        self._file.flush()
        os.fsync(self._file.fileno())
        return {"ends": list(self._ends), "checksums": list(self._checksums)}

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
        self._checksums.append(zlib.crc32(rows))

    def __getitem__(self, index: int) -> VoxelMeans:
        return VoxelMeans(np.frombuffer(self._read(index), dtype="<f4").reshape(-1, _COLUMNS))

    def __iter__(self) -> Iterator[VoxelMeans]:
        return (self[index] for index in range(len(self)))

    def _read(self, index: int) -> bytes:
        begin, end = self._ends[index], self._ends[index + 1]
        self._file.seek(begin)
        return self._file.read(end - begin)

    def close(self) -> None:
        """Give the space back."""
        self._file.close()
