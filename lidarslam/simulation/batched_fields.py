"""Height fields as tensors, and what is known of them around and at a grid position."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from lidarslam.simulation.world import HeightField

# Half the width of a window; what is searched window by window takes this many cells at a time.
WINDOW_CELLS = 4


@dataclass(frozen=True, eq=False)
class Fields:
    """Height fields of W worlds, F each, of at most (X, Y) points, with U x V windows.

    Window (u, v) is all grid points within `WINDOW_CELLS` cells of point (u, v) * `WINDOW_CELLS` along either axis:
    whatever piece of a line is at most `WINDOW_CELLS` cells long lies within the window nearest to its middle.

    Attributes:
        origins: (W, F, 2) float64 world position of the first grid point.
        cells_m: (W, F) float64.
        last: (W, F, 2) float32 greatest index along either axis, -1 where there is no field.
        bounds: (W, F, 2) float32 lowest and highest z.
        heights: (W, F, X, Y) float32.
        lowest, highest: (W, F, U, V) float32 z in each window.
    """

    origins: Tensor
    cells_m: Tensor
    last: Tensor
    bounds: Tensor
    heights: Tensor
    lowest: Tensor
    highest: Tensor

    @classmethod
    def from_worlds(cls, worlds: Sequence[Sequence[HeightField]], device: torch.device | str = "cpu") -> "Fields":
        """The fields of each world, in their order."""
        shapes = [field.heights.shape for fields in worlds for field in fields]
        most = max(len(fields) for fields in worlds)
        size = np.max([(2, 2), *shapes], axis=0)
        heights = np.zeros((len(worlds), most, *size))
        origins, cells_m = np.zeros((len(worlds), most, 2)), np.ones((len(worlds), most))
        last, bounds = np.full((len(worlds), most, 2), -1.0), np.zeros((len(worlds), most, 2))
        for w, fields in enumerate(worlds):
            for f, field in enumerate(fields):
                missing = [(0, int(n)) for n in size - field.heights.shape]
                # Repeating the border keeps the windows there as tight as elsewhere.
                heights[w, f] = np.pad(field.heights, missing, mode="edge")
                origins[w, f], cells_m[w, f] = field.origin_xy, field.cell_m
                last[w, f] = np.array(field.heights.shape) - 1.0
                bounds[w, f] = field.heights.min(), field.heights.max()
        surface = torch.tensor(heights, dtype=torch.float32, device=device)
        return cls(
            torch.tensor(origins, dtype=torch.float64, device=device),
            torch.tensor(cells_m, dtype=torch.float64, device=device),
            torch.tensor(last, dtype=torch.float32, device=device),
            torch.tensor(bounds, dtype=torch.float32, device=device),
            surface,
            lowest=-_window_maxima(-surface),
            highest=_window_maxima(surface),
        )


def _window_maxima(heights: Tensor) -> Tensor:
    """(W, F, U, V) greatest of heights (W, F, X, Y) in each window."""
    if not heights.numel():
        return heights.new_zeros(*heights.shape[:2], 1, 1)
    return max_pool2d(heights, 2 * WINDOW_CELLS + 1, stride=WINDOW_CELLS, padding=WINDOW_CELLS, ceil_mode=True)


def window_bounds(fields: Fields, field: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest z in the windows nearest to grid positions x and y.

    Args:
        fields: of all worlds.
        field: index among all worlds' fields, w * F + f.
        x, y: in cells.
    """
    rows, columns = fields.lowest.shape[-2:]
    u, v = ((a / WINDOW_CELLS + 0.5).long().clamp(0, n - 1) for a, n in ((x, rows), (y, columns)))
    index = (field * rows + u) * columns + v
    return fields.lowest.view(-1)[index], fields.highest.view(-1)[index]


def surface_at(fields: Fields, field: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """z of the surface's triangles at grid positions x and y, which lie within the field."""
    rows, columns = fields.heights.shape[-2:]
    last = fields.last.view(-1, 2)[field]
    i, j = (torch.minimum(a.clamp(min=0.0).floor(), last[..., k] - 1.0) for k, a in enumerate((x, y)))
    u, v = x - i, y - j
    here = (field * rows + i.long()) * columns + j.long()
    heights = fields.heights.view(-1)
    z00, z11 = heights[here], heights[here + columns + 1]
    corner = heights[here + torch.where(u >= v, columns, 1)]
    return z00 + torch.maximum(u, v) * (corner - z00) + torch.minimum(u, v) * (z11 - corner)
