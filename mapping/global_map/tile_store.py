"""Square tiles of the global map, and those of their voxels that do not fit into memory."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.state import BlockFile
from lidarslam.mapping.global_map.voxels import Layout, Voxels, column_cells, row_cells

# Edge of a tile, as near as a whole number of voxels comes.
_EDGE_M = 100.0
_CODE_BITS = 32

Tile = tuple[int, int]
"""Number of a tile along x and y: tile (0, 0) begins at the origin of the world."""


@dataclass(frozen=True)
class Tiling:
    """Tiles of a whole number of voxels, so that each voxel lies in one."""

    voxel_size_m: float
    cells: int  # voxels along an edge

    @classmethod
    def of(cls, voxel_size_m: float) -> "Tiling":
        """Of a map with such voxels."""
        return cls(voxel_size_m, max(1, round(_EDGE_M / voxel_size_m)))

    @property
    def edge_m(self) -> float:
        """Edge of a tile."""
        return self.cells * self.voxel_size_m

    def codes(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """(M,) the tiles of voxels as single numbers, in the order of tiles, by the voxels' keys (M,)."""
        return ((column_cells(keys) // self.cells) << _CODE_BITS) + row_cells(keys) // self.cells

    def tiles(self, keys: NDArray[np.int64]) -> list[Tile]:
        """The tiles that voxels lie in, sorted, by the voxels' sorted keys (M,)."""
        return [_tile(int(code)) for code in _distinct(self.codes(keys))]

    def bounds(self, tile: Tile, margin_m: float = 0.0) -> tuple[Tile, Tile]:
        """The cells of a tile and a margin around it: the first in x and y, and those after the last."""
        margin = math.ceil(margin_m / self.voxel_size_m)
        (x, y), cells = tile, self.cells
        return (x * cells - margin, y * cells - margin), ((x + 1) * cells + margin, (y + 1) * cells + margin)

    def around(self, low: Tile, high: Tile) -> list[Tile]:
        """The tiles that have cells between bounds."""
        xs, ys = (range(low[axis] // self.cells, (high[axis] - 1) // self.cells + 1) for axis in (0, 1))
        return [(x, y) for x in xs for y in ys]


class TileStore(BlockFile):
    """Voxels on disk, a block for all those of a tile that left memory together.

    A tile that is visited again starts empty in memory; its blocks are added up when it is read. The file grows with
    the voxels that leave memory, and nothing in it is ever changed: see `BlockFile`.
    """

    _parts: list[tuple[Tile, Layout]]  # of blocks
    brightest: float  # the largest intensity of a voxel here

    def __init__(self, directory: Path | None = None, file: Path | None = None) -> None:
        super().__init__(directory, file)
        self._parts, self.brightest = [], 0.0
        self._blocks: dict[Tile, list[int]] = {}

    def _after_restore(self) -> None:
        self._blocks = {}
        for index, (tile, _) in enumerate(self._parts):
            self._blocks.setdefault(tile, []).append(index)

    @property
    def tiles(self) -> set[Tile]:
        """The tiles that have voxels here."""
        return set(self._blocks)

    @property
    def layout(self) -> Layout:
        """The columns that any of the voxels has."""
        return Layout.union([layout for _, layout in self._parts])

    def take(self, voxels: Voxels, tiling: Tiling, recent: NDArray[np.int64], most: int) -> Voxels:
        """What is left in memory of sorted voxels, without the tiles that have no recent ones, by sorted keys (R,).

        If these are still more than `most`, all are taken. An OSError is raised where the disk is full.
        """
        codes = tiling.codes(voxels.keys)
        tiles = _distinct(codes)
        of, stays = np.searchsorted(tiles, codes), np.isin(tiles, _distinct(tiling.codes(recent)))
        if np.count_nonzero(stays[of]) > most:
            stays[:] = False
        for index in np.flatnonzero(~stays):
            self._append(_tile(int(tiles[index])), voxels.chosen(of == index))
        return voxels.chosen(stays[of])

    def voxels(self, tile: Tile) -> list[Voxels]:
        """The blocks of a tile, the earliest first, each of them sorted."""
        found = []
        for index in self._blocks.get(tile, []):
            block, layout = self.read(index), self._parts[index][1]
            count = len(block) // (8 + 4 * layout.width)
            rows = np.frombuffer(block, dtype="<f4", offset=8 * count).reshape(count, layout.width)
            found.append(Voxels(np.frombuffer(block, dtype="<i8", count=count), rows, layout))
        return found

    def _append(self, tile: Tile, voxels: Voxels) -> None:
        keys, rows = (np.ascontiguousarray(a, dtype=t) for a, t in ((voxels.keys, "<i8"), (voxels.sums, "<f4")))
        self.write(keys.tobytes() + rows.tobytes())
        self._blocks.setdefault(tile, []).append(len(self._parts))
        self._parts.append((tile, voxels.layout))
        self.brightest = max(self.brightest, voxels.layout.largest_intensity(voxels.sums))


def _distinct(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted codes of tiles, each once; in the order of keys they come in few runs."""
    return np.unique(codes[np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))]) if len(codes) else codes


def _tile(code: int) -> Tile:
    x = (code + (1 << (_CODE_BITS - 1))) >> _CODE_BITS
    return x, code - (x << _CODE_BITS)
