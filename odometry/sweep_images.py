"""From scans to the images that network and alignment work on."""

from collections.abc import Sequence

import torch
from torch import Tensor

from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from odometry.image_config import ImageConfig
from odometry.normals import surface_normals
from odometry.projection import ImageGrid, project
from odometry.sweeps import SweepImages

# A scan of fewer points, as of a covered sensor, does not tell which elevations the sensor sees.
_ENOUGH_POINTS = 200


class Imager:
    """Makes images of one sensor's scans; the rows' elevations are those of the first scan with points enough.

    Until there is one, they are those of the scan that had most.
    """

    def __init__(self, config: ImageConfig, device: torch.device | str = "cpu") -> None:
        self._config = config
        self._device = torch.device(device)
        self._grid: ImageGrid | None = None
        self._grid_points = 0  # of the scan that the grid is from

    def state(self) -> State:
        """The elevations of the rows, and how many points they are from."""
        grid = self._grid
        limits = None if grid is None else {"low": grid.elevation_low, "high": grid.elevation_high}
        return {"limits": limits, "points": self._grid_points}

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self._grid = saved.optional("limits", self._grid_between)
        self._grid_points = saved.integer("points")

    def _grid_between(self, limits: Saved) -> ImageGrid:
        low, high = limits.number("low"), limits.number("high")
        return ImageGrid(self._config.rows, self._config.columns, low, high)

    def images(self, scans: Sequence[Scan]) -> SweepImages:
        """The scans as images, normals included."""
        made = [self._image(scan) for scan in scans]
        images = torch.stack([image for image, _, _ in made])  # (B, 4, H, W)
        normals = surface_normals(images, self._config.normals)
        limits = images.new_tensor([(grid.elevation_low, grid.elevation_high) for _, _, grid in made])  # (B, 2)
        return SweepImages(
            images[:, :3].contiguous(), normals, torch.stack([offsets for _, offsets, _ in made]), *limits.unbind(1)
        )

    def _image(self, scan: Scan) -> tuple[Tensor, Tensor, ImageGrid]:
        """Range image (4, H, W), seconds from the middle of the sweep (H, W), and where the rows lie."""
        points = torch.from_numpy(scan.points).to(self._device, torch.float32)
        grid = self._grid_of(points)
        by_ring = self._config.order == "ring" and scan.rings is not None
        rings = torch.from_numpy(scan.rings).to(self._device) if by_ring and scan.rings is not None else None
        projection = project(points, grid, rings=rings)
        index = projection.index[0]
        if scan.time_offsets is None or not len(scan):
            return projection.images[0], points.new_zeros(index.shape), grid
        offsets = torch.from_numpy(scan.time_offsets - middle_offset_s(scan)).to(self._device, torch.float32)
        return projection.images[0], torch.where(index >= 0, offsets[index.clamp(min=0)], 0.0), grid

    def _grid_of(self, points: Tensor) -> ImageGrid:
        """The grid for a scan, which is that of an earlier one unless this one tells more."""
        if self._grid is None or self._grid_points < min(_ENOUGH_POINTS, len(points)):
            self._grid = ImageGrid.around(points, self._config.rows, self._config.columns)
            self._grid_points = len(points)
        return self._grid


def middle_offset_s(scan: Scan) -> float:
    """Seconds from a scan's stamp to the middle of its sweep; 0 where points have no times."""
    if scan.time_offsets is None or not len(scan):
        return 0.0
    return float(0.5 * (scan.time_offsets.min() + scan.time_offsets.max()))
