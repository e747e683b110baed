"""Scan patterns: the directions and times of a sweep's rays."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray


class Rays(NamedTuple):
    """The rays of one sweep in the order of time, shot by shot: `lasers` rays to each of the `columns` shots."""

    directions: FloatArray  # (N, 3) unit, in the LiDAR frame (x forward, z up)
    fractions: FloatArray  # (N,) of the sweep when each is fired, in [0, 1), never decreasing
    rings: NDArray[np.int32]  # (N,) the laser


@dataclass(frozen=True, eq=False)
class Spinning:
    """A column of lasers that turns once a sweep."""

    elevations_deg: FloatArray  # (L,) of each laser, by ring
    azimuth_offsets_deg: FloatArray  # (L,) seen from above, counter-clockwise from the middle of the column
    firing: FloatArray  # (L,) of the column's time slot when each laser fires, in [0, 1); the column turns on meanwhile
    columns: int  # in a turn
    start_azimuth_deg: float = 180.0  # where the turn starts, counter-clockwise from x
    clockwise: bool = True  # the sense of rotation, seen from above

    def __post_init__(self) -> None:
        for name in ("azimuth_offsets_deg", "firing"):
            if getattr(self, name).shape != self.elevations_deg.shape:
                raise ValueError(f"Spinning.{name} must be {self.elevations_deg.shape}")
        if self.firing.min() < 0.0 or self.firing.max() >= 1.0:
            raise ValueError("Spinning.firing must lie in [0, 1)")

    @property
    def lasers(self) -> int:
        """Rays a column."""
        return len(self.elevations_deg)

    @property
    def column_angle(self) -> float:
        """Angle between two columns, radians."""
        return 2.0 * np.pi / self.columns

    @cached_property
    def _rays(self) -> Rays:
        order = np.argsort(self.firing, kind="stable")
        fractions = (np.arange(self.columns)[:, None] + self.firing[order]) / self.columns
        turned = (-2.0 if self.clockwise else 2.0) * np.pi * fractions
        azimuth = np.deg2rad(self.start_azimuth_deg + self.azimuth_offsets_deg[order]) + turned
        elevation = np.broadcast_to(np.deg2rad(self.elevations_deg[order]), azimuth.shape)
        rings = np.broadcast_to(order.astype(np.int32), azimuth.shape)
        return Rays(directions(azimuth.ravel(), elevation.ravel()), fractions.ravel(), rings.ravel())

    def rays(self, scan_index: int) -> Rays:  # noqa: ARG002  every turn is like the other
        """The rays of one turn, the same arrays for each."""
        return self._rays


@dataclass(frozen=True, eq=False)
class Rosette:
    """Lasers that draw a pattern which goes on from sweep to sweep and does not close within any recording.

    The line of sight turns about z while it nods up and down; the two frequencies and the sweep rate have irrational
    ratios. The lasers nod with phases spread over a period, or together and a constant angle above one another.
    """

    elevation_range_deg: tuple[float, float]  # lowest and highest
    lasers: int
    columns: int
    turns_per_sweep: float  # of the line of sight
    nods_per_sweep: float
    laser_step_deg: float = 0.0  # between lasers that nod together; 0 for phases spread over a period

    @property
    def column_angle(self) -> float:
        """Largest angle between two shots of the same laser, radians."""
        low, high = np.deg2rad(self.elevation_range_deg)
        nod = 2.0 * (high - low) * self.nods_per_sweep / self.columns
        return float(np.hypot(nod, 2.0 * np.pi * self.turns_per_sweep / self.columns))

    def rays(self, scan_index: int) -> Rays:
        """The rays of the sweep with that index."""
        fractions = np.arange(self.columns) / self.columns
        sweeps = scan_index + fractions[:, None]
        number = np.arange(self.lasers)
        phase = self.nods_per_sweep * sweeps + (0.0 if self.laser_step_deg else number / self.lasers)
        # A triangle wave covers all elevations evenly, as the real pattern does to within a factor of two.
        rising = 2.0 * np.abs(np.mod(phase, 1.0) - 0.5)
        low, high = np.deg2rad(self.elevation_range_deg)
        above = np.deg2rad(self.laser_step_deg) * number
        elevation = low + rising * (high - low - above[-1]) + above
        azimuth = np.broadcast_to(np.pi - 2.0 * np.pi * np.mod(self.turns_per_sweep * sweeps, 1.0), elevation.shape)
        rings = np.tile(np.arange(self.lasers, dtype=np.int32), self.columns)
        return Rays(directions(azimuth.ravel(), elevation.ravel()), np.repeat(fractions, self.lasers), rings)


@dataclass(frozen=True, eq=False)
class RisleyPrisms:
    """Lasers above one another behind two prisms that turn in opposite senses: petals about the x axis.

    Each prism deflects by half of `radius_deg`; their frequencies and the sweep rate have irrational ratios, so that
    the petals do not repeat within any recording.
    """

    radius_deg: float  # of the circle that one laser's petals fill
    laser_step_deg: float
    lasers: int
    columns: int
    turns_per_sweep: tuple[float, float]  # of each prism

    @property
    def column_angle(self) -> float:
        """Largest angle between two shots of the same laser, radians."""
        return float(np.deg2rad(self.radius_deg) * np.pi * sum(self.turns_per_sweep) / self.columns)

    def rays(self, scan_index: int) -> Rays:
        """The rays of the sweep with that index."""
        fractions = np.arange(self.columns) / self.columns
        one, other = 2.0 * np.pi * np.multiply.outer(self.turns_per_sweep, scan_index + fractions)
        radius = 0.5 * np.deg2rad(self.radius_deg)
        steps = np.deg2rad(self.laser_step_deg) * (np.arange(self.lasers) - 0.5 * (self.lasers - 1))
        elevation = radius * (np.sin(one) - np.sin(other))[:, None] + steps
        azimuth = np.repeat(radius * (np.cos(one) + np.cos(other)), self.lasers)
        rings = np.tile(np.arange(self.lasers, dtype=np.int32), self.columns)
        return Rays(directions(azimuth, elevation.ravel()), np.repeat(fractions, self.lasers), rings)


ScanPattern = Spinning | Rosette | RisleyPrisms
"""A LiDAR's optics: `columns` shots a sweep of `lasers` rays each, `column_angle` between two shots of a laser."""


def directions(azimuth: FloatArray, elevation: FloatArray) -> FloatArray:
    """Unit vectors (N, 3) of azimuths (N,), counter-clockwise from x, and elevations (N,), upwards; radians."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
