"""The submaps of keyframes on disk: hours of recording would not fit into memory."""

from pathlib import Path

import numpy as np

from lidarslam.core.state import BlockFile
from lidarslam.mapping.global_map.global_map import VoxelMeans
from lidarslam.mapping.global_map.voxels import Layout


class SubmapStore(BlockFile):
    """Submaps in a file, in order; see `BlockFile`."""

    _layouts: list[Layout]

    def __init__(self, directory: Path | None = None, file: Path | None = None) -> None:
        super().__init__(directory, file)
        self._layouts = []

    def append(self, means: VoxelMeans) -> None:
        """Keep one more.

        Raises:
            OSError: the disk is full.
        """
        self.write(np.ascontiguousarray(means.rows, dtype="<f4").tobytes())
        self._layouts.append(means.layout)

    def __getitem__(self, index: int) -> VoxelMeans:
        layout = self._layouts[index]
        return VoxelMeans(np.frombuffer(self.read(index), dtype="<f4").reshape(-1, layout.width), layout)
