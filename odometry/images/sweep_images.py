"""From scans to the images that network and alignment work on."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from odometry.images.image_config import ImageConfig
from odometry.images.normal_config import NormalConfig
from odometry.images.normals import surface_normals
from odometry.images.projection import ImageGrid, Points, Projection, project_sweep
from odometry.images.sweeps import SweepImages

# A scan of fewer points, as of a covered sensor, does not tell which elevations the sensor sees.
_ENOUGH_POINTS = 200
# What alignment gets at most. Finer sensors have rings closer together than their points scatter.
_MOST_ROWS = 64
# Numbers of rows that are tried where they are not known, the finest first.
_ROWS = (64, 48, 32)
# Pixels filled in as many rows, as a share of those filled in the network's, that make them the sensor's own.
_FILLED, _FILLED_BY_RINGS = 0.8, 0.5
# Part of the columns in which a sensor that turns sees something. The points of one that does not lie in no rows.
_SEEN_COLUMNS = 0.5
# Where rows are close together a patch need not be wide; one that is wider than high takes its tilt from the noise of
# a ring, and the ground that seems tilted holds alignment back.
_FINE_PATCH = {"rows": 2, "columns": 1, "wide_columns": 2}


@dataclass(frozen=True, eq=False)
class ScanImages:
    """A scan as it is shown to the network and to alignment; both may be shown the same."""

    network: SweepImages
    alignment: SweepImages


class Imager:
    """Makes images of one sensor's scans; the rows are those of the first scan with points enough.

    Until there is one, they are those of the scan that had most. The network's images are always of the same size;
    alignment sees as many rows as the sensor has, because an image that shows the nearest point of several rings holds
    it back along the way.

    Args:
        config: of the network's images.
        alignment_rows: of alignment's; None: as many as the sensor has rings, from those of the network to 64.
    """

    def __init__(self, config: ImageConfig, alignment_rows: int | None = None) -> None:
        self._config = config
        self._asked_rows = alignment_rows
        self._grid: ImageGrid | None = None
        self._alignment_rows = config.rows
        self._grid_points = 0  # of the scan that the grid is from

    def state(self) -> State:
        """The elevations of the rows, how many alignment sees, and how many points they are from."""
        grid = self._grid
        limits = None if grid is None else {"low": grid.elevation_low, "high": grid.elevation_high}
        return {"limits": limits, "alignment_rows": self._alignment_rows, "points": self._grid_points}

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self._grid = saved.optional("limits", self._grid_between)
        self._alignment_rows = saved.integer("alignment_rows")
        self._grid_points = saved.integer("points")

    def _grid_between(self, limits: Saved) -> ImageGrid:
        low, high = limits.number("low"), limits.number("high")
        return ImageGrid(self._config.rows, self._config.columns, low, high)

    def images(self, scan: Scan) -> ScanImages:
        """The scan as images, normals included."""
        grid = self._grid_of(scan)
        rings = scan.rings if self._config.order == "ring" else None
        times, middle = scan.time_offsets, middle_offset_s(scan)
        if self._alignment_rows == grid.rows:
            (projection,) = project_sweep(scan.points, times, middle, (grid,), rings)
            images = _with_normals(projection, grid, self._config.normals)
            return ScanImages(images, images)
        fine = ImageGrid(self._alignment_rows, grid.columns, grid.elevation_low, grid.elevation_high)
        shown = project_sweep(scan.points, times, middle, (grid, fine), rings)
        normals = self._config.normals
        fine_normals = normals.model_copy(update=_FINE_PATCH) if fine.rows > grid.rows else normals
        return ScanImages(_with_normals(shown[0], grid, normals), _with_normals(shown[1], fine, fine_normals))

    def _grid_of(self, scan: Scan) -> ImageGrid:
        """The grid for a scan, which is that of an earlier one unless this one tells more."""
        if self._grid is None or self._grid_points < min(_ENOUGH_POINTS, len(scan)):
            points = scan.points.astype(np.float32)
            self._grid = ImageGrid.around(points, self._config.rows, self._config.columns)
            self._grid_points = len(scan)
            self._alignment_rows = self._asked_rows or rows_of_sensor(points, scan.rings, self._grid)
        return self._grid


def _with_normals(projection: Projection, grid: ImageGrid, config: NormalConfig) -> SweepImages:
    normals = surface_normals(projection.image, config)
    return SweepImages(projection.image[:3], normals, projection.offsets, grid.elevation_low, grid.elevation_high)


def rows_of_sensor(points: Points, rings: NDArray[np.int32] | None, grid: ImageGrid) -> int:
    """How many rows an image can have without many of its pixels being empty, from those of the grid to 64.

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
    """(rows, W) which pixels have a point, in an image of so many rows."""
    fine = ImageGrid(rows, grid.columns, grid.elevation_low, grid.elevation_high)
    return project_sweep(points, None, 0.0, (fine,))[0].index >= 0


def middle_offset_s(scan: Scan) -> float:
    """Seconds from a scan's stamp to the middle of its sweep; 0 where points have no times."""
    if scan.time_offsets is None or not len(scan):
        return 0.0
    return float(0.5 * (scan.time_offsets.min() + scan.time_offsets.max()))
