"""A LiDAR: where it looks and how well it measures."""

from dataclasses import dataclass
from typing import Literal

from lidarslam.simulation.sensors.scan_patterns import Rays, ScanPattern

Driver = Literal["velodyne", "ouster", "hesai", "livox"]


@dataclass(frozen=True)
class RangeModel:
    """How a measured range differs from the true one; lengths in metres.

    Attributes:
        min_range_m, max_range_m: nothing is measured outside; at `max_range_m` half the rays that meet a surface of
            80 % reflectivity head-on come back.
        sigma_m: standard deviation close by, on a surface that faces the sensor.
        sigma_per_m: what each metre of range adds to it.
        beam_divergence: full angle of the beam, radians: its footprint on a slanted surface spreads the range, and at
            the edge of something near it returns the edge.
        resolution_m: step of the range in the sensor's packets.
        dropout: share of rays lost for no reason.
    """

    min_range_m: float
    max_range_m: float
    sigma_m: float
    sigma_per_m: float
    beam_divergence: float
    resolution_m: float
    dropout: float = 0.005


@dataclass(frozen=True, eq=False)
class Sensor:
    """A LiDAR.

    Attributes:
        name: as on the command line.
        driver: whose point fields its recordings have.
        rate_hz: sweeps a second.
        pattern: its rays.
        ranging: its errors.
    """

    name: str
    driver: Driver
    rate_hz: float
    pattern: ScanPattern
    ranging: RangeModel

    @property
    def period_s(self) -> float:
        """Duration of a sweep."""
        return 1.0 / self.rate_hz

    @property
    def rays_per_scan(self) -> int:
        """Rays fired in a sweep."""
        return self.pattern.columns * self.pattern.lasers

    def rays(self, scan_index: int) -> Rays:
        """Directions (N, 3), time fractions (N,) and rings (N,) of one sweep in the LiDAR frame."""
        return self.pattern.rays(scan_index)
