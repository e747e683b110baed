"""Voxels of a map: rows of sums over their points by their keys, and square tiles of those that leave memory.

The columns are those of every map, and those of scans' attributes. Intensity and colour are summed over the points that
have one. Ring and time are those of the earliest point."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part, prefetch
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import PointAttributes
from lidarslam.core.state import BlockFile, Shape
from lidarslam.mapping.surfels.voxel_hash import BITS, EMPTY, OFFSET, PREFETCHED, Keys, cell_of, key_of, reach_m

POSITION, VIEW, COUNT = slice(0, 3), slice(3, 6), 6
_GEOMETRY = 7
_INTENSITY, _RGB, _FIRST = 2, 4, 3
# Of a point without a time: a time later than all others, its low part, and its ring.
_NO_FIRST = (np.inf, 0.0, -1.0)
_MASK = (1 << BITS) - 1

Rows = NDArray[np.float32]

_reach_m = compiled_part(reach_m)
# Edge of a tile, as near as a whole number of voxels comes.
_EDGE_M = 100.0
_CODE_BITS = 32
# Bits that voxels are sorted by at a time.
_DIGIT_BITS = 11
Tile = tuple[int, int]
"""Number of a tile along x and y: tile (0, 0) begins at the origin of the world."""


@dataclass(frozen=True)
class Layout:
    """The columns of rows (N, width) besides position (3), direction to the sensor (3) and number of points."""

    intensity: bool = False  # its sum, and the number of points that have one
    rgb: bool = False  # the sums of red, green and blue, and the number of points that have them
    # the time of the earliest point as the sum of two float32, exact to some microseconds since 1970, and its ring
    first: bool = False

    @classmethod
    def of(cls, attributes: PointAttributes) -> "Layout":
        """Columns for these attributes."""
        return cls(attributes.intensity is not None, attributes.rgb is not None, attributes.time is not None)

    @classmethod
    def union(cls, layouts: "Sequence[Layout]") -> "Layout":
        """The columns that any of them has."""
        return cls(*(any(getattr(one, name) for one in layouts) for name in ("intensity", "rgb", "first")))

    @property
    def summed(self) -> int:
        """Number of columns that are sums, the first ones."""
        return _GEOMETRY + _INTENSITY * self.intensity + _RGB * self.rgb

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.summed + _FIRST * self.first

    def parts(self, rows: Rows) -> tuple[Rows, Rows, Rows]:
        """Views of the columns of intensity (N, 2), colour (N, 4) and earliest point (N, 3), as far as they exist."""
        at = _GEOMETRY + _INTENSITY * self.intensity
        return rows[:, _GEOMETRY:at], rows[:, at : self.summed], rows[:, self.summed :]

    def write(self, attributes: PointAttributes, rows: Rows) -> None:
        """Write the attributes of N points into their rows (N, width)."""
        intensity, rgb, first = self.parts(rows)
        if attributes.intensity is not None:
            known = np.isfinite(attributes.intensity)
            intensity[:, 0], intensity[:, 1] = np.where(known, attributes.intensity, 0.0), known
        if attributes.rgb is not None:
            rgb[:, :3], rgb[:, 3] = attributes.rgb, 1.0
        if attributes.time is not None:
            first[:, 0] = attributes.time
            first[:, 1] = attributes.time - first[:, 0].astype(np.float64)
            first[:, 2] = -1.0 if attributes.ring is None else attributes.ring

    def widened(self, rows: Rows, layout: "Layout") -> Rows:
        """Rows with the columns of another layout, which has all of these."""
        if layout == self:
            return rows
        wide = np.zeros((len(rows), layout.width), dtype=np.float32)
        wide[:, :_GEOMETRY] = rows[:, :_GEOMETRY]
        if layout.first:
            wide[:, layout.summed :] = _NO_FIRST
        for old, new in zip(self.parts(rows), layout.parts(wide), strict=True):
            if old.shape[1]:
                new[:] = old
        return wide

    def largest_intensity(self, rows: Rows) -> float:
        """The largest mean intensity; 0 where none is known."""
        intensity = self.parts(rows)[0]
        return float(np.nanmax(_means(intensity, unknown=np.nan), initial=0.0)) if self.intensity else 0.0

    def attributes(self, rows: Rows) -> PointAttributes:
        """Means of intensity and colour, ring and time of the earliest point; rings as far as one is known."""
        intensity, rgb, first = self.parts(rows)
        ring = first[:, 2].astype(np.int32) if self.first else None
        return PointAttributes(
            intensity=_means(intensity, unknown=np.nan)[:, 0] if self.intensity else None,
            rgb=np.round(_means(rgb, unknown=0.0)).astype(np.uint8) if self.rgb else None,
            ring=None if ring is None or (ring < 0).all() else ring,
            time=first[:, 0].astype(np.float64) + first[:, 1] if self.first else None,
        )


def _means(sums: Rows, unknown: float) -> NDArray[np.float32]:
    """Rows divided by their last column, the number of points."""
    counts = sums[:, -1:]
    return np.where(counts > 0.0, sums[:, :-1] / np.maximum(counts, 1.0), np.float32(unknown))


@dataclass(frozen=True, eq=False)
class Voxels:
    """Rows over points of one voxel each: keys (M,) int64, sums (M, width); once reduced, sorted and unique."""

    keys: Annotated[NDArray[np.int64], Shape(None)]
    sums: Annotated[NDArray[np.float32], Shape(None, None)]  # the earliest point of none is at infinity
    layout: Layout

    def __len__(self) -> int:
        return len(self.keys)

    @classmethod
    def join(cls, parts: "Sequence[Voxels]") -> "Voxels":
        """All of them after one another, equal keys not added up."""
        layout = Layout.union([part.layout for part in parts])
        wide = (part.layout.widened(part.sums, layout) for part in parts)
        return cls(
            np.concatenate([np.empty(0, dtype=np.int64), *(part.keys for part in parts)]),
            np.concatenate([np.empty((0, layout.width), dtype=np.float32), *wide]),
            layout,
        )

    def reduced(self) -> "Voxels":
        """Rows of equal keys added up, in the order of keys."""
        return self._reduced(radix_order(self.keys))

    def united(self, other: "Voxels") -> "Voxels":
        """Both of them, reduced; both are reduced already."""
        both = Voxels.join([self, other])
        return both._reduced(np.argsort(both.keys, kind="stable"))  # merges sorted parts in linear time

    def _reduced(self, order: NDArray[np.intp]) -> "Voxels":
        unique, totals = np.empty_like(self.keys), np.empty_like(self.sums)
        count = add_up(order, self.keys, self.sums, self.layout.summed, unique, totals)
        # In place: nobody else has them yet.
        unique.resize(count, refcheck=False)
        totals.resize((count, totals.shape[1]), refcheck=False)
        return Voxels(unique, totals, self.layout)

    def chosen(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> "Voxels":
        """Some of them."""
        return Voxels(self.keys[rows], self.sums[rows], self.layout)

    def within(self, low: tuple[int, int], high: tuple[int, int]) -> "Voxels":
        """Those of sorted ones whose cells lie from `low` up to, not including, `high` in x and y."""
        ends = np.clip([low[0] + OFFSET, high[0] + OFFSET], 0, _MASK + 1).astype(np.int64) << (2 * BITS)
        between = self.chosen(slice(*np.searchsorted(self.keys, ends)))
        y = row_cells(between.keys)
        return between.chosen((y >= low[1]) & (y < high[1]))


def row_cells(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells (M,) along y of voxels, by their keys (M,)."""
    return ((keys >> BITS) & _MASK) - OFFSET


@compiled
def write_sums(points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float, keys: Keys, sums: Rows) -> None:
    """Write keys (N,) and the first seven columns of rows (N, C) of the points (N, 3) of a scan, in the LiDAR frame.

    Keys of points beyond the reach of the voxels are `EMPTY`.
    """
    T, sensor, reach = T_world_lidar, T_world_lidar[:3, 3], _reach_m(voxel_size_m)
    for n in range(len(points)):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if not (abs(x) < reach and abs(y) < reach and abs(z) < reach):
            keys[n] = EMPTY
            continue
        u, v, w = sensor[0] - x, sensor[1] - y, sensor[2] - z
        distance = math.sqrt(u * u + v * v + w * w)
        i, j, k = cell_of(x / voxel_size_m), cell_of(y / voxel_size_m), cell_of(z / voxel_size_m)
        keys[n] = key_of(i, j, k)
        # Within the voxel float32 is exact enough.
        sums[n, 0], sums[n, 1], sums[n, 2] = x - i * voxel_size_m, y - j * voxel_size_m, z - k * voxel_size_m
        sums[n, 3], sums[n, 4], sums[n, 5], sums[n, 6] = u / distance, v / distance, w / distance, 1.0


@compiled
def radix_order(keys: Keys) -> NDArray[np.intp]:
    """Indices (N,) that sort voxels' keys (N,), equal ones in their order.

    By the digits, the last one first, of the cells' coordinates within the range of all, which is small: in a fraction
    of the time of a sort that compares keys.
    """
    low, high = np.full(3, _MASK, dtype=np.int64), np.zeros(3, dtype=np.int64)
    for key in keys:
        for axis in range(3):
            value = (key >> (BITS * axis)) & _MASK
            low[axis], high[axis] = min(low[axis], value), max(high[axis], value)
    shifts, bits = np.zeros(3, dtype=np.int64), 0
    for axis in range(3):
        shifts[axis] = bits
        while (high[axis] - low[axis]) >> (bits - shifts[axis]) > 0:
            bits += 1
    numbers, order = np.empty(len(keys), dtype=np.int64), np.arange(len(keys))
    for n in range(len(keys)):
        numbers[n] = 0
        for axis in range(3):
            numbers[n] |= (((keys[n] >> (BITS * axis)) & _MASK) - low[axis]) << shifts[axis]
    next_numbers, next_order = np.empty_like(numbers), np.empty_like(order)
    for shift in range(0, bits, _DIGIT_BITS):
        ends = np.zeros((1 << _DIGIT_BITS) + 1, dtype=np.int64)
        for number in numbers:
            ends[((number >> shift) & ((1 << _DIGIT_BITS) - 1)) + 1] += 1
        ends = np.cumsum(ends)
        for n in range(len(keys)):
            digit = (numbers[n] >> shift) & ((1 << _DIGIT_BITS) - 1)
            next_numbers[ends[digit]], next_order[ends[digit]] = numbers[n], order[n]
            ends[digit] += 1
        numbers, next_numbers, order, next_order = next_numbers, numbers, next_order, order
    return order


@compiled
def add_up(order: NDArray[np.intp], keys: Keys, sums: Rows, summed: int, unique: Keys, totals: Rows) -> int:
    """Write the M keys and totals (M, C) of rows (N, C) of equal keys (N,), by an order that sorts these; return M.

    The first `summed` columns are summed; the others are those of the earliest row, by the first two of them.
    """
    count, columns = 0, sums.shape[1]
    for n in range(len(order)):
        ahead = order[min(n + PREFETCHED, len(order) - 1)]
        prefetch(keys, ahead)
        prefetch(sums, ahead)
        row = order[n]
        if count == 0 or keys[row] != unique[count - 1]:
            unique[count] = keys[row]
            # Copying a whole row brings the text of its error, which takes 4 s to compile.
            for column in range(columns):
                totals[count, column] = sums[row, column]
            count += 1
        else:
            for column in range(summed):
                totals[count - 1, column] += sums[row, column]
            if summed < columns and _is_earlier(sums[row], totals[count - 1], summed):
                for column in range(summed, columns):
                    totals[count - 1, column] = sums[row, column]
    return count


@compiled_part
def _is_earlier(row: Rows, other: Rows, column: int) -> bool:
    """Whether the time of one row (C,) is before another's: a column and the rest of it in the next one."""
    high, rest = row[column] - other[column], row[column + 1] - other[column + 1]
    return bool(high < 0.0 or (high == 0.0 and rest < 0.0))


@dataclass(frozen=True)
class Tiling:
    """Tiles of a whole number of voxels, so that each voxel lies in one."""

    voxel_size_m: float

    @property
    def cells(self) -> int:
        """Number of voxels along an edge."""
        return max(1, round(_EDGE_M / self.voxel_size_m))

    @property
    def edge_m(self) -> float:
        """Edge of a tile."""
        return self.cells * self.voxel_size_m

    def codes(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """(M,) the tiles of voxels as single numbers, in the order of tiles, by the voxels' keys (M,)."""
        columns = ((keys >> (2 * BITS)) - OFFSET) // self.cells
        return (columns << _CODE_BITS) + row_cells(keys) // self.cells

    def tiles(self, keys: NDArray[np.int64]) -> list[Tile]:
        """The tiles that voxels lie in, sorted, by the voxels' sorted keys (M,)."""
        return [_tile(int(code)) for code in _distinct(self.codes(keys))]

    def lies_in(self, tile: Tile, keys: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(M,) which voxels lie in a tile, by their keys (M,)."""
        return np.asarray(self.codes(keys) == (tile[0] << _CODE_BITS) + tile[1])

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
