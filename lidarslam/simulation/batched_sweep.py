"""The rays of a sweep as an image, and range images of what they met, in torch."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from lidarslam.simulation.scan_patterns import Spinning
from lidarslam.simulation.sensor import RangeModel, Sensor


@dataclass(frozen=True, eq=False)
class SweepGrid:
    """The rays of a sweep as an image, row = ring and column = azimuth in the order in which they are fired.

    Attributes:
        directions: (H, W, 3) float32, unit, in the LiDAR frame.
        fractions: (W,) float64 when within the sweep each column begins.
    """

    directions: Tensor
    fractions: Tensor

    def __post_init__(self) -> None:
        if self.directions.ndim != 3 or self.directions.shape[2] != 3:
            raise ValueError(f"SweepGrid.directions must be (H, W, 3), got {tuple(self.directions.shape)}")
        if self.fractions.shape != self.directions.shape[1:2]:
            raise ValueError(f"SweepGrid.fractions must be (W,), got {tuple(self.fractions.shape)}")

    @classmethod
    def of_sensor(
        cls, sensor: Sensor, scan_index: int = 0, columns: int | None = None, device: torch.device | str = "cpu"
    ) -> "SweepGrid":
        """The rays of one sweep of a sensor, H lasers by W shots; or by so many columns, if the sensor spins.

        Raises:
            ValueError: the sensor does not spin and cannot have another number of columns.
        """
        pattern = sensor.pattern
        if columns is not None:
            if not isinstance(pattern, Spinning):
                raise ValueError(f"the columns of {sensor.name} cannot be chosen: it does not spin")
            pattern = replace(pattern, columns=columns)
        rays = pattern.rays(scan_index)
        # (W * H,) in the order of time -> (H, W) by ring
        shot = np.repeat(np.arange(pattern.columns), pattern.lasers)
        directions = np.empty((pattern.lasers, pattern.columns, 3), dtype=np.float32)
        directions[rays.rings, shot] = rays.directions
        fractions = rays.fractions.reshape(pattern.columns, pattern.lasers)[:, 0]
        return cls(torch.tensor(directions, device=device), torch.tensor(fractions, dtype=torch.float64, device=device))


def range_images(ranges: Tensor, grid: SweepGrid) -> Tensor:
    """Images (B, 4, H, W) of x, y, z and range from ranges (B, H, W), zero where they are infinite."""
    finite = torch.where(ranges.isfinite(), ranges, 0.0)
    directions = grid.directions.to(ranges).movedim(-1, 0)  # (H, W, 3) -> (3, H, W)
    return torch.cat([finite[:, None] * directions, finite[:, None]], dim=1)


def with_range_noise(images: Tensor, model: RangeModel, generator: torch.Generator) -> Tensor:
    """Range images (B, 4, H, W) with noise along the rays, dropouts and the sensor's limits; the rest is zero.

    Without the effects of incidence and of edges, for which surfaces would have to be known.
    """
    ranges = images[:, 3]
    noise = torch.empty_like(ranges).normal_(generator=generator)
    lost = torch.empty_like(ranges).uniform_(generator=generator)
    measured = ranges + noise * (model.sigma_m + model.sigma_per_m * ranges)
    kept = (ranges > 0.0) & (lost >= model.dropout)
    kept &= (measured >= model.min_range_m) & (measured <= model.max_range_m)
    scale = torch.where(kept, measured / ranges.clamp(min=1e-6), 0.0)
    return images * scale[:, None]
