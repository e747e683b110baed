"""The submaps of keyframes on disk: hours of recording would not fit into memory."""

import os
import tempfile
import zlib
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.state.stateful import Saved, State, Stateful
from lidarslam.mapping.global_map.global_map import VoxelMeans
from lidarslam.mapping.global_map.voxel_rows import Layout


class SubmapStore(Stateful):
    """Submaps in a file, in order.

    Args:
        directory: where a file without a name lies while it is needed; None: the system's temporary directory.
        file: a file that outlives the program instead, for `restore`.
    """

    _ends: list[int]  # bytes
    _checksums: list[int]
    _layouts: list[Layout]

    def __init__(self, directory: Path | None = None, file: Path | None = None) -> None:
        # Closed by whoever made the store.
        self._file = tempfile.TemporaryFile(dir=directory) if file is None else file.open("a+b")  # noqa: SIM115
        self._path = file
        self._ends, self._checksums, self._layouts = [0], [], []

    def state(self) -> State:
        """Where submaps end; they are on the disk by now.

        Raises:
            OSError: the disk is full.
        """
        self._file.flush()
        os.fsync(self._file.fileno())
        return super().state()

    def restore(self, saved: Saved) -> None:
        """Go on from a state.

        Raises:
            InputError: the file is damaged.
        """
        super().restore(saved)
        for index, checksum in enumerate(self._checksums):
            if zlib.crc32(self._read(index)) != checksum:
                raise InputError(f"{self._path}: is damaged (submap {index}); begin again with --overwrite")

    def _after_restore(self) -> None:
        if (
            self._ends[:1] != [0]
            or len(self._ends) != len(self._checksums) + 1
            or len(self._layouts) != len(self._checksums)
            or min(np.diff(self._ends), default=0) < 0
        ):
            raise ValueError(f"{len(self._checksums)} submaps end at {self._ends[:2]}, ...")

    def __len__(self) -> int:
        return len(self._checksums)

    def append(self, means: VoxelMeans) -> None:
        """Keep one more; what lies behind the last was written after the state that was restored.

        Raises:
            OSError: the disk is full.
        """
        rows = np.ascontiguousarray(means.rows, dtype="<f4").tobytes()
        self._file.truncate(self._ends[-1])
        self._file.seek(self._ends[-1])
        self._file.write(rows)
        self._ends.append(self._ends[-1] + len(rows))
        self._checksums.append(zlib.crc32(rows))
        self._layouts.append(means.layout)

    def __getitem__(self, index: int) -> VoxelMeans:
        layout = self._layouts[index]
        return VoxelMeans(np.frombuffer(self._read(index), dtype="<f4").reshape(-1, layout.width), layout)

    def _read(self, index: int) -> bytes:
        self._file.seek(self._ends[index])
        return self._file.read(self._ends[index + 1] - self._ends[index])

    def close(self) -> None:
        """Give the space back."""
        self._file.close()
