"""Point clouds as range images: spherical projection."""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from odometry.images import image_kernels as kernels

Floats = NDArray[np.float32]
Points = FloatArray | Floats

# A scan's elevations are taken between these quantiles, so that single stray points do not stretch the rows.
_STRAY_SHARE = 0.002
# Rows of a scan with one ring only are this far apart in all: more than the noise of elevations.
_LEAST_HEIGHT = math.radians(1.0)
_HEIGHT_WITHOUT_POINTS = math.radians(15.0)


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
    def around(cls, points: Points, rows: int, columns: int) -> "ImageGrid":
        """The grid that spans the elevations of one scan, points (N, 3), but for the outermost 0.2 % on either side.

        It spans at least 1 degree, from the lowest point up; and -15 to 15 degrees if there are no points.
        """
        elevations = elevations_of(points)
        if not len(elevations):
            return cls(rows, columns, -_HEIGHT_WITHOUT_POINTS, _HEIGHT_WITHOUT_POINTS)
        strays = int(_STRAY_SHARE * len(elevations))
        last = len(elevations) - 1 - strays
        ordered = np.partition(elevations, (strays, last))
        low, high = float(ordered[strays]), float(ordered[last])
        return cls(rows, columns, low, max(high, low + _LEAST_HEIGHT))

    @property
    def rows_per_radian(self) -> float:
        """Of elevation."""
        return max(self.rows - 1, 1) / (self.elevation_high - self.elevation_low)

    def place(self, points: Points) -> tuple[FloatArray, FloatArray]:
        """Where points (..., 3) lie in the image: row and column coordinates (...), continuous.

        Centres of rows are at integers, and columns begin at integers: the pixel is (floor(row + 0.5),
        floor(column)). Rows may lie outside the image; columns are in [0, W).
        """
        x, y, z = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
        row = (np.arctan2(z, np.hypot(x, y)) - self.centre_of_row_0) * self.rows_per_radian
        column = np.mod(np.arctan2(y, x), 2.0 * math.pi) * (self.columns / (2.0 * math.pi))
        # An azimuth just below 0 may be rounded to 2 pi, which is 0 again.
        return row, np.where(column < self.columns, column, 0.0)

    @property
    def centre_of_row_0(self) -> float:
        """Its elevation, rad: that of a single row lies in the middle of all it covers."""
        return self.elevation_low if self.rows > 1 else 0.5 * (self.elevation_low + self.elevation_high)


@dataclass(frozen=True, eq=False)
class Projection:
    """A range image, and which points it shows.

    Attributes:
        image: (4, H, W) float32 of x, y, z and range, metres; zero where no point is.
        offsets: (H, W) float32 seconds from the middle of the sweep; zero where no point is, or no time is known.
        index: (H, W) int64, the point in each pixel; -1 where there is none.
    """

    image: Floats
    offsets: Floats
    index: NDArray[np.int64]


def project(points: Points, grid: ImageGrid, rings: NDArray[np.integer] | None = None) -> Projection:
    """The nearest of the points (M, 3), metres, in each pixel; of equally near ones, the first.

    Left out are points that are not finite, at the origin, or above or below the grid. With rings (M,), 0 the lowest
    laser and negative ones left out, the row is ring // k in place of the elevation, where k is the least with which
    all rings fit into the H rows: the ring itself, if there are no more than H.
    """
    return project_sweep(points, None, 0.0, (grid,), rings)[0]


def project_sweep(
    points: Points, times: FloatArray | None, middle: float, grids: tuple[ImageGrid] | tuple[ImageGrid, ImageGrid],
    rings: NDArray[np.integer] | None = None,
) -> list[Projection]:  # fmt: skip
    """As `project`, on one grid or two at a time, with the points' times (M,), of which `middle` is that of the sweep.

    Rings are for the first grid.
    """
    rows = np.empty(0, dtype=np.int64) if rings is None else _rows_of_rings(rings, grids[0].rows)
    rasters = [_raster(grid) for grid in grids]
    points = cast(Points, np.ascontiguousarray(points))
    kernels.nearest_in_pixels(points, rows, rasters[0], rasters[1] if len(rasters) > 1 else _NO_RASTER)
    known = np.empty(0) if times is None else times
    return [_projection(points, known, middle, grid, raster) for grid, raster in zip(grids, rasters, strict=True)]


_NO_RASTER = kernels.Raster(0, 1, 0.0, 1.0, np.empty(0, dtype=np.int64), np.empty(0, dtype=np.float32))


def _raster(grid: ImageGrid) -> kernels.Raster:
    pixels = grid.rows * grid.columns
    index, ranges = np.empty(pixels, dtype=np.int64), np.empty(pixels, dtype=np.float32)
    return kernels.Raster(grid.rows, grid.columns, grid.centre_of_row_0, grid.rows_per_radian, index, ranges)


def _projection(
    points: Points, times: FloatArray, middle: float, grid: ImageGrid, raster: kernels.Raster
) -> Projection:
    shape = (grid.rows, grid.columns)
    image, offsets = np.empty((4, *shape), dtype=np.float32), np.empty(shape, dtype=np.float32)
    kernels.write_pixels(
        points, times, middle, raster.shown, raster.ranges, image.reshape(4, -1), offsets.reshape(-1)
    )  # fmt: skip
    return Projection(image, offsets, raster.shown.reshape(shape))


def _rows_of_rings(rings: NDArray[np.integer], rows: int) -> NDArray[np.int64]:
    lasers = np.asarray(rings, dtype=np.int64)
    return lasers // (max(int(lasers.max()), 0) // rows + 1) if len(lasers) else lasers


def elevations_of(points: Points) -> FloatArray:
    """(N,) radians, of those of the points (M, 3) that are finite and not at the origin."""
    # Coordinates of a float32 have squares that are in range, or else are no point.
    squares = np.square(np.asarray(points, dtype=np.float32)).sum(axis=1)
    x, y, z = np.asarray(points, dtype=np.float64)[np.isfinite(squares) & (squares > 0.0)].T
    return np.asarray(np.arctan2(z, np.hypot(x, y)), dtype=np.float64)
