"""Scans as the range images that the network and alignment work on."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.spin_axis import image_axes
from lidarslam.core.state import Shape, Stateful
from lidarslam.odometry.config import ImageConfig
from lidarslam.odometry.images.normals import FINE_PATCHES, PATCHES, surface_normals
from lidarslam.odometry.images.projection import Floats, ImageGrid, Points, Projection, project

# The grid of a scan of fewer points, as of a covered sensor, is replaced by that of a scan of more.
_ENOUGH_POINTS = 200
# Finer sensors have rings closer together than their points scatter.
_MOST_ROWS = 64
# Numbers of rows that are tried where they are not known, the finest first.
_ROWS = (64, 48, 32)
# Pixels filled in as many rows, as a share of those filled in the network's, that make them the sensor's own.
_FILLED, _FILLED_BY_RINGS = 0.8, 0.5
# Columns that a rotating sensor fills at least. The points of others do not lie in rows.
_SEEN_COLUMNS = 0.5
# Pixels nearer than this, of which fine patches are too narrow, and the difference of ranges on one surface.
_NEAR_M, _SAME_M = 5.0, 0.2
# Columns from one to the next that a median is taken of.
_MEDIAN_STEP = 4


@dataclass(frozen=True, eq=False)
class SweepImages:
    """A sweep as images, float32."""

    # (3, H, W) metres in the images' axes at the time of each point; zero where empty
    points: Annotated[Floats, Shape(3, None, None)]
    normals: Annotated[Floats, Shape(3, None, None)]  # (3, H, W) unit, zero where there is none
    # (H, W) seconds from the middle of the sweep; all zero where unknown or already compensated
    offsets: Annotated[Floats, Shape(None, None)]
    # low, high: elevation of the centres of the first and the last row, radians
    low: float
    high: float

    def median_range_m(self) -> float:
        """Of the points of every fourth column, the lower of the two in the middle; 0 when there are none."""
        x, y, z = self.points[:, :, ::_MEDIAN_STEP]
        squares = x * x + y * y + z * z
        seen = squares[squares > 0.0]
        return float(np.sqrt(np.partition(seen, (len(seen) - 1) // 2)[(len(seen) - 1) // 2])) if len(seen) else 0.0

    def mean_inverse_square_range(self) -> float:
        """Of the pixels of every fourth column that have a normal, 1/m^2; 0 when there are none."""
        x, y, z = self.points[:, :, ::_MEDIAN_STEP]
        u, v, w = self.normals[:, :, ::_MEDIAN_STEP]
        squares = (x * x + y * y + z * z)[u * u + v * v + w * w > 0.0]
        return float((1.0 / squares).mean()) if len(squares) else 0.0

    def with_normal(self) -> int:
        """Number of pixels with a normal."""
        return int(np.count_nonzero(self.normals.any(axis=0)))

    def share_with_normal(self) -> float:
        """Of the pixels that have a point; 0 when there are none."""
        return self.with_normal() / max(int(np.count_nonzero(self.points.any(axis=0))), 1)


@dataclass(frozen=True, eq=False)
class ScanImages:
    """A scan as the network and alignment see it; both may see the same."""

    network: SweepImages
    alignment: SweepImages
    R_image_lidar: Annotated[FloatArray, Shape(3, 3)]  # the axes of the images, whose z is the spin axis


class Imager(Stateful):
    """Makes images of one sensor's scans, about the axis and on the grid of the first scan with points enough.

    The network's images are always of the same size. Alignment sees as many rows as the sensor has rings, from those of
    the network to 64, because an image that shows the nearest point of several rings biases it along the path.
    """

    _grid: ImageGrid | None
    _grid_points: int  # of the scan that axes and grid are from
    _R_image_lidar: Annotated[FloatArray, Shape(3, 3)]
    _alignment_rows: int

    def __init__(self, config: ImageConfig) -> None:
        self._config = config
        self._grid = None
        self._grid_points = 0
        self._R_image_lidar = np.eye(3)
        self._alignment_rows = config.rows

    def images(self, scan: Scan) -> ScanImages:
        """The scan as images, normals included."""
        grid, points = self._grid_and_points(scan)
        if self._alignment_rows == grid.rows:
            coarse = _images(project(points, [grid])[0], grid, scan)
            return ScanImages(coarse, coarse, self._R_image_lidar)
        fine = replace(grid, rows=self._alignment_rows)
        shown = project(points, [grid, fine])
        network, alignment = _images(shown[0], grid, scan), _images(shown[1], fine, scan, is_fine=True)
        _fill_near(alignment.normals, shown[1].image[3], network.normals, shown[0].image[3])
        return ScanImages(network, alignment, self._R_image_lidar)

    def _grid_and_points(self, scan: Scan) -> tuple[ImageGrid, FloatArray]:
        """The grid, and the points (N, 3) of the scan in the images' axes."""
        is_first = self._grid is None or self._grid_points < min(_ENOUGH_POINTS, len(scan))
        if is_first:
            self._R_image_lidar = image_axes(scan.points)
        turned = scan.points
        if not np.array_equal(self._R_image_lidar, np.eye(3)):
            turned = np.ascontiguousarray(turned @ self._R_image_lidar.T)
        if self._grid is None or is_first:
            points = turned.astype(np.float32)
            self._grid = ImageGrid.around(points, self._config.rows, self._config.columns)
            self._grid_points = len(scan)
            self._alignment_rows = rows_of_sensor(points, scan.rings, self._grid)
        return self._grid, turned


def _images(projection: Projection, grid: ImageGrid, scan: Scan, is_fine: bool = False) -> SweepImages:
    offsets = np.zeros(projection.index.shape, dtype=np.float32)
    if scan.time_offsets is not None and len(scan):
        seconds = scan.time_offsets.take(projection.index) - scan.middle_offset_s
        np.copyto(offsets, seconds, where=projection.index >= 0, casting="same_kind")
    normals = surface_normals(projection.image, FINE_PATCHES if is_fine else PATCHES)
    return SweepImages(projection.image[:3], normals, offsets, grid.elevation_low, grid.elevation_high)


def _fill_near(normals: Floats, ranges: Floats, wider: Floats, wider_ranges: Floats) -> None:
    """Write normals (3, H, W) of near pixels without one, from an image of fewer rows (3, h, W) with wider patches.

    Ranges are (H, W) and (h, W).
    """
    height, rows = len(ranges), len(wider_ranges)
    above = np.arange(height) * rows // height
    missing = (normals[0] == 0.0) & (normals[1] == 0.0) & (normals[2] == 0.0) & (ranges > 0.0) & (ranges < _NEAR_M)
    missing &= np.abs(wider_ranges.take(above, axis=0) - ranges) < _SAME_M
    for normal, other in zip(normals, wider, strict=True):
        np.copyto(normal, other.take(above, axis=0), where=missing)


def rows_of_sensor(points: Points, rings: NDArray[np.int32] | None, grid: ImageGrid) -> int:
    """Largest number of rows of an image with few empty pixels, from those of the grid to 64.

    As many as there are rings, where these are known; else as many as are filled as well as the rows of the grid.
    """
    shown = _shown(points, grid, grid.rows)
    if rings is None and shown.any(axis=0).mean() < _SEEN_COLUMNS:
        return grid.rows
    most = _MOST_ROWS if rings is None else min(len(np.unique(rings)), _MOST_ROWS)
    least = (_FILLED if rings is None else _FILLED_BY_RINGS) * shown.mean()
    fitting = (rows for rows in sorted({most, *_ROWS}, reverse=True) if grid.rows < rows <= most)
    return next((rows for rows in fitting if _shown(points, grid, rows).mean() >= least), grid.rows)


def _shown(points: Points, grid: ImageGrid, rows: int) -> NDArray[np.bool_]:
    """(rows, W) which pixels have a point, in an image with this many rows."""
    return project(points, [replace(grid, rows=rows)])[0].index >= 0
