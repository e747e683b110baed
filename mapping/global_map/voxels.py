"""Sums over the points of voxels, by the voxels' keys."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.state.stateful import ANY_NUMBER, Shape, Within
from lidarslam.mapping.global_map import kernels
from lidarslam.mapping.global_map.voxel_rows import COUNT, Layout
from lidarslam.mapping.surfels.hash_kernels import BITS, OFFSET

_MASK = (1 << BITS) - 1


@dataclass(frozen=True, eq=False)
class Voxels:
    """Sums over points of one voxel each: keys (M,) int64, sums (M, width); once reduced, sorted and unique."""

    keys: Annotated[NDArray[np.int64], Shape(None), Within(low=0)]
    sums: Annotated[NDArray[np.float32], Shape(None, None), ANY_NUMBER]  # the earliest point of none is at infinity
    layout: Layout

    def __post_init__(self) -> None:
        if self.sums.shape != (len(self.keys), self.layout.width):
            raise ValueError(f"expected sums ({len(self.keys)}, {self.layout.width}), got {self.sums.shape}")

    def __len__(self) -> int:
        return len(self.keys)

    def require_sums(self) -> None:
        """Refuse sums that are not finite, or of no point, with a ValueError."""
        summed = self.sums[:, : self.layout.summed]
        if not (np.isfinite(summed).all() and (self.sums[:, COUNT] > 0.0).all()):
            raise ValueError("the sums of a voxel are not finite, or of no point")

    def require_sorted(self) -> None:
        """Refuse voxels that are not reduced, with a ValueError."""
        self.require_sums()
        if (np.diff(self.keys) <= 0).any():
            raise ValueError("voxels are not in the order of their keys")

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
        unique, totals = np.empty_like(self.keys), np.empty_like(self.sums)
        order = np.argsort(self.keys)
        count = kernels.add_up(order, self.keys, self.sums, self.layout.summed, unique, totals)
        return Voxels(unique[:count].copy(), totals[:count].copy(), self.layout)

    def united(self, other: "Voxels") -> "Voxels":
        """Both of them, reduced; both are reduced already."""
        layout = Layout.union([self.layout, other.layout])
        sums = [part.layout.widened(part.sums, layout) for part in (self, other)]
        unique = np.empty(len(self) + len(other), dtype=np.int64)
        totals = np.empty((len(unique), layout.width), dtype=np.float32)
        count = kernels.unite(self.keys, sums[0], other.keys, sums[1], layout.summed, unique, totals)
        return Voxels(unique[:count].copy(), totals[:count].copy(), layout)

    def chosen(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> "Voxels":
        """Some of them."""
        return Voxels(self.keys[rows], self.sums[rows], self.layout)

    def within(self, low: tuple[int, int], high: tuple[int, int]) -> "Voxels":
        """Those of sorted ones whose cells lie from `low` up to, not including, `high` in x and y."""
        ends = np.clip([low[0] + OFFSET, high[0] + OFFSET], 0, _MASK + 1).astype(np.int64) << (2 * BITS)
        between = self.chosen(slice(*np.searchsorted(self.keys, ends)))
        y = row_cells(between.keys)
        return between.chosen((y >= low[1]) & (y < high[1]))


def column_cells(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells (M,) along x of voxels, by their keys (M,)."""
    return (keys >> (2 * BITS)) - OFFSET


def row_cells(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells (M,) along y of voxels, by their keys (M,)."""
    return ((keys >> BITS) & _MASK) - OFFSET
