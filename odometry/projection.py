"""Point clouds as range images: spherical projection in torch, the same on every device."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from odometry.image_kernels import nearest_in_pixels

# A scan's elevations are taken between these quantiles, so that single stray points do not stretch the rows.
_STRAY_SHARE = 0.002
# Rows of a scan with one ring only are this far apart in all: more than the noise of elevations.
_LEAST_HEIGHT = math.radians(1.0)
_HEIGHT_WITHOUT_POINTS = math.radians(15.0)
_EMPTY = torch.iinfo(torch.int64).max
_INDEX_BITS = 32


@dataclass(frozen=True)
class ImageGrid:
    """The pixels of a range image: rows by elevation from the lowest up, columns by azimuth, without a seam.

    Attributes:
        rows: H.
        columns: W; column c covers azimuths from c to c + 1 times 2 pi / W.
        elevation_low: elevation of the centre of row 0, rad.
        elevation_high: elevation of the centre of row H - 1, rad. A single row covers all between the two.

    Raises:
        ValueError: there are no pixels, or the elevations do not ascend.
    """

    rows: int
    columns: int
    elevation_low: float
    elevation_high: float

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"an ImageGrid needs pixels, got {self.rows} x {self.columns}")
        if not self.elevation_low < self.elevation_high:
            raise ValueError(f"elevations must ascend, got {self.elevation_low:g} to {self.elevation_high:g}")

    @classmethod
    def around(cls, points: Tensor, rows: int, columns: int) -> "ImageGrid":
        """The grid that spans the elevations of one scan, points (N, 3), but for the outermost 0.2 % on either side.

        It spans at least 1 degree, from the lowest point up; and -15 to 15 degrees if there are no points.
        """
        points = _at_least_float32(points)
        elevations = _elevations(points[_has_direction(points)])
        if not len(elevations):
            return cls(rows, columns, -_HEIGHT_WITHOUT_POINTS, _HEIGHT_WITHOUT_POINTS)
        strays = int(_STRAY_SHARE * len(elevations))
        low = float(elevations.kthvalue(1 + strays).values)
        high = float(elevations.kthvalue(len(elevations) - strays).values)
        return cls(rows, columns, low, max(high, low + _LEAST_HEIGHT))

    def place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Where points (..., 3) lie in the image: row and column coordinates (...), continuous.

        Centres of rows are at integers, and columns begin at integers: the pixel is (floor(row + 0.5),
        floor(column)). Rows may lie outside the image; columns are in [0, W).
        """
        points = _at_least_float32(points)
        height = self.elevation_high - self.elevation_low
        if self.rows > 1:
            row = (_elevations(points) - self.elevation_low) * ((self.rows - 1) / height)
        else:
            row = (_elevations(points) - (self.elevation_low + self.elevation_high) / 2.0) / height
        azimuth = torch.atan2(points[..., 1], points[..., 0]).remainder(2.0 * math.pi)
        column = azimuth * (self.columns / (2.0 * math.pi))
        # An azimuth just below 0 may be rounded to 2 pi, which is 0 again.
        return row, torch.where(column < self.columns, column, 0.0)


@dataclass(frozen=True, eq=False)
class Projection:
    """Range images, and which points they show.

    Attributes:
        images: (B, 4, H, W) float32 of x, y, z and range, metres; zero where no point is.
        index: (B, H, W) int64, the point in each pixel; -1 where there is none.
    """

    images: Tensor
    index: Tensor


def project(
    points: Tensor, grid: ImageGrid, image: Tensor | None = None, count: int = 1, rings: Tensor | None = None
) -> Projection:
    """The nearest of the points (M, 3) in each pixel of `count` images; of equally near ones, the first.

    Left out are points that are not finite, at the origin, above or below the grid, or of an image that is not
    there. With rings the result is that of ring // k in place of the elevation, where k is the least with which all
    rings fit into the H rows: the ring itself, if there are no more than H.

    Args:
        points: (M, 3) of any floating-point type, metres, in the sensor's frame.
        grid: of all images.
        image: (M,) int64, in which image each point is; None puts all into the first.
        count: B.
        rings: (M,) integers, 0 the lowest laser; negative ones are left out.
    """
    points = _at_least_float32(points)
    if points.device.type == "cpu" and points.dtype == torch.float32 and image is None and count == 1:
        index = _compiled(points, grid, rings)
        return Projection(_images_of(points, index), index)
    row, column = grid.place(points)
    row = (row + 0.5).floor() if rings is None else _rows_of_rings(rings, grid.rows)
    image = torch.zeros_like(row, dtype=torch.int64) if image is None else image
    kept = _has_direction(points) & (row >= 0) & (row < grid.rows) & (image >= 0) & (image < count)
    pixels = count * grid.rows * grid.columns
    # Points that are left out go into an extra pixel at the end: to select the others would have a GPU waited for.
    pixel = (image * grid.rows + torch.where(kept, row, 0).long()) * grid.columns + column.nan_to_num().long()
    index = _nearest(_ranges(points), torch.where(kept, pixel, pixels), pixels)
    index = index.view(count, grid.rows, grid.columns)
    return Projection(_images_of(points, index), index)


def _compiled(points: Tensor, grid: ImageGrid, rings: Tensor | None) -> Tensor:
    """The nearest point (1, H, W) in each pixel of one image, -1 without, in the processor's memory."""
    index = np.empty(grid.rows * grid.columns, dtype=np.int64)
    nearest_m = np.empty(len(index), dtype=np.float32)
    rows = np.empty(0, dtype=np.int64) if rings is None else _rows_of_rings(rings, grid.rows).long().numpy()
    height = grid.elevation_high - grid.elevation_low
    # A single row covers all between the two: its centre lies in their middle.
    low = grid.elevation_low if grid.rows > 1 else grid.elevation_low + 0.5 * height
    per_radian = max(grid.rows - 1, 1) / height
    nearest_in_pixels(
        points.detach().contiguous().numpy(), rows, low, per_radian, grid.rows, grid.columns, index, nearest_m
    )
    return torch.from_numpy(index).view(1, grid.rows, grid.columns)


def rotate_columns(images: Tensor, shift: Tensor | int) -> Tensor:
    """Images of the clouds turned about z by whole columns, to the left (x towards y) where positive.

    Args:
        images: (B, C, H, W), C at least 2; channels 0 and 1 are components along x and y, of points or of normals.
        shift: columns, one for all or (B,) integers.
    """
    width = images.shape[-1]
    shifts = torch.as_tensor(shift, device=images.device).expand(len(images))
    columns = (torch.arange(width, device=images.device) - shifts[:, None]).remainder(width)
    moved = images.gather(3, columns[:, None, None, :].expand(images.shape))
    angles = shifts.double()[:, None, None] * (2.0 * math.pi / width)
    cos, sin = angles.cos().to(images.dtype), angles.sin().to(images.dtype)
    x, y = moved[:, 0], moved[:, 1]
    turned = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=1)
    return torch.cat([turned, moved[:, 2:]], dim=1)


def mirror(images: Tensor) -> Tensor:
    """Images (B, C, H, W) of the clouds with y negated; channel 1 is the component along y."""
    flipped = images.flip(-1)
    return torch.cat([flipped[:, :1], -flipped[:, 1:2], flipped[:, 2:]], dim=1)


def _nearest(ranges: Tensor, pixel: Tensor, pixels: int) -> Tensor:
    """The nearest point of each pixel (pixels,), -1 without; ranges (M,) float32, pixel (M,), those above ignored.

    The bits of positive floats, read as integers, are in the order of the floats. With the index below them each
    point has a key of its own, and the least does not depend on the order in which a device looks at them.
    """
    keys = (ranges.view(torch.int32).long() << _INDEX_BITS) | torch.arange(len(ranges), device=ranges.device)
    least = torch.full((pixels + 1,), _EMPTY, dtype=torch.int64, device=ranges.device)
    least = least.scatter_reduce(0, pixel, keys, "amin")[:pixels]
    return torch.where(least == _EMPTY, -1, least & ((1 << _INDEX_BITS) - 1))


def _images_of(points: Tensor, index: Tensor) -> Tensor:
    """Images (B, 4, H, W) float32 of the points (M, 3) at index (B, H, W)."""
    if index.numel() < len(points):  # what is not shown need not be worked on
        chosen = index.flatten()
        shown = torch.where((chosen >= 0)[:, None], points[chosen.clamp(min=0)], 0.0)
        points, index = shown, torch.arange(len(shown), device=index.device).view(index.shape)
    values = torch.cat([points.float(), _ranges(points)[:, None]], dim=1)
    # The row of zeros at the end is what index -1 takes.
    values = torch.cat([values, values.new_zeros(1, 4)]).T
    return values[:, index].transpose(0, 1).contiguous()


def _rows_of_rings(rings: Tensor, rows: int) -> Tensor:
    if not len(rings):
        return rings
    step = torch.div(rings.max(), rows, rounding_mode="floor").clamp(min=0) + 1
    return torch.div(rings, step, rounding_mode="floor")


def _at_least_float32(points: Tensor) -> Tensor:
    return points if points.dtype == torch.float64 else points.float()


def _ranges(points: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    return (x * x + y * y + z * z).sqrt().float()


def _elevations(points: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    return torch.atan2(z, torch.hypot(x, y))


def _has_direction(points: Tensor) -> Tensor:
    ranges = _ranges(points)
    return ranges.isfinite() & (ranges > 0.0)
