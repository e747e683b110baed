"""A LiDAR: its scan pattern and its range errors."""

from dataclasses import dataclass
from typing import Literal

from lidarslam.simulation.sensors.scan_patterns import ScanPattern

Driver = Literal["velodyne", "ouster", "hesai", "livox"]


@dataclass(frozen=True)
class RangeModel:
    """Errors of measured ranges; lengths in metres.

    At `max_range_m` half the rays that meet a surface of 80 % reflectivity head-on come back. The beam's footprint on a
    slanted surface spreads the range, and at the edge of a near object it returns the edge.
    """

    min_range_m: float  # nothing is measured outside
    max_range_m: float
    sigma_m: float  # standard deviation close by, on a surface that faces the sensor
    sigma_per_m: float  # added to it by each metre of range
    beam_divergence: float  # full angle, radians
    resolution_m: float  # step of the range in the sensor's packets
    dropout: float = 0.005  # share of rays lost at random


@dataclass(frozen=True, eq=False)
class Sensor:
    """A LiDAR, by its name on the command line."""

    name: str
    driver: Driver  # whose point fields its recordings have
    rate_hz: float  # sweeps a second
    pattern: ScanPattern
    ranging: RangeModel
    has_rings: bool = True  # whether points carry the number of their laser

    @property
    def period_s(self) -> float:
        """Duration of a sweep."""
        return 1.0 / self.rate_hz
