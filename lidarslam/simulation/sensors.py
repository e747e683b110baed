"""LiDARs: their scan patterns and range errors, and the table of all sensors, after manuals and data sheets.

Rings are numbered as by the driver. Rates are 10 Hz throughout. Noise close by is the precision (one sigma) where it is
published and half the stated accuracy where it is not; its growth with range is inferred from the published figures for
near and far. Ouster's rays start at the sensor's origin, like all others here, not on the real circle of 16 to 28 mm
around it.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import choose


class Rays(NamedTuple):
    """The rays of one sweep in the order of time, shot by shot: `lasers` rays to each of the `columns` shots."""

    directions: FloatArray  # (N, 3) unit, in the LiDAR frame (x forward, z up)
    fractions: FloatArray  # (N,) of the sweep when each is fired, in [0, 1), never decreasing
    rings: NDArray[np.int32]  # (N,) the laser


def _rays(azimuth: FloatArray, elevation: FloatArray, fractions: FloatArray, rings: NDArray[np.int64]) -> Rays:
    """Rays from azimuths, counter-clockwise from x, and elevations, upwards, which broadcast to (columns, lasers)."""
    azimuth, elevation, fractions, rings = (
        array.ravel() for array in np.broadcast_arrays(azimuth, elevation, fractions, rings)
    )
    level = np.cos(elevation)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return Rays(directions, fractions, rings.astype(np.int32))


@dataclass(frozen=True, eq=False)
class Spinning:
    """A column of lasers that turns once a sweep."""

    elevations_deg: FloatArray  # (L,) of each laser, by ring
    azimuth_offsets_deg: FloatArray  # (L,) seen from above, counter-clockwise from the middle of the column
    firing: FloatArray  # (L,) of the column's time slot when each laser fires, in [0, 1); the column turns on meanwhile
    columns: int  # in a turn
    start_azimuth_deg: float = 180.0  # where the turn starts, counter-clockwise from x

    @property
    def lasers(self) -> int:
        """Rays per column."""
        return len(self.elevations_deg)

    @property
    def column_angle(self) -> float:
        """Angle between two columns, radians."""
        return 2.0 * np.pi / self.columns

    @cached_property
    def _rays(self) -> Rays:
        order = np.argsort(self.firing, kind="stable")
        fractions = (np.arange(self.columns)[:, None] + self.firing[order]) / self.columns
        turned = -2.0 * np.pi * fractions  # clockwise, seen from above
        azimuth = np.deg2rad(self.start_azimuth_deg + self.azimuth_offsets_deg[order]) + turned
        return _rays(azimuth, np.deg2rad(self.elevations_deg[order]), fractions, order)

    def rays(self, scan_index: int) -> Rays:  # noqa: ARG002  every turn is like the other
        """The rays of one turn, the same arrays for each."""
        return self._rays


@dataclass(frozen=True, eq=False)
class Rosette:
    """Lasers that draw a pattern which continues from sweep to sweep and does not close within any recording.

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
        fractions = np.arange(self.columns) / self.columns
        sweeps = scan_index + fractions[:, None]
        number = np.arange(self.lasers)
        phase = self.nods_per_sweep * sweeps + (0.0 if self.laser_step_deg else number / self.lasers)
        # A triangle wave covers all elevations evenly, as the real pattern does to within a factor of two.
        rising = 2.0 * np.abs(np.mod(phase, 1.0) - 0.5)
        low, high = np.deg2rad(self.elevation_range_deg)
        above = np.deg2rad(self.laser_step_deg) * number
        elevation = low + rising * (high - low - above[-1]) + above
        azimuth = np.pi - 2.0 * np.pi * np.mod(self.turns_per_sweep * sweeps, 1.0)
        return _rays(azimuth, elevation, fractions[:, None], number)


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
        fractions = np.arange(self.columns) / self.columns
        one, other = 2.0 * np.pi * np.multiply.outer(self.turns_per_sweep, scan_index + fractions)
        radius = 0.5 * np.deg2rad(self.radius_deg)
        steps = np.deg2rad(self.laser_step_deg) * (np.arange(self.lasers) - 0.5 * (self.lasers - 1))
        elevation = radius * (np.sin(one) - np.sin(other))[:, None] + steps
        azimuth = (radius * (np.cos(one) + np.cos(other)))[:, None]
        return _rays(azimuth, elevation, fractions[:, None], np.arange(self.lasers))


ScanPattern = Spinning | Rosette | RisleyPrisms
"""A LiDAR's optics: `columns` shots a sweep of `lasers` rays each, `column_angle` between two shots of a laser."""


Driver = Literal["velodyne", "ouster", "hesai", "livox"]


@dataclass(frozen=True)
class RangeModel:
    """Errors of measured ranges; lengths in metres.

    At `max_range_m` half the rays that meet a surface of 80 % reflectivity head-on return. The beam's footprint on a
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
    rate_hz: float  # sweeps per second
    pattern: ScanPattern
    ranging: RangeModel
    has_rings: bool = True  # whether points carry the number of their laser

    @property
    def period_s(self) -> float:
        return 1.0 / self.rate_hz


# Altitude angles of one OS0-64 and one OS1-128, from their own metadata as published with the Ouster SDK.
_OS0_64_DEG = np.array([
    45.85, 44.07, 42.82, 41.05, 39.80, 38.06, 36.81, 35.09, 33.81, 32.14, 30.85, 29.20, 27.92, 26.28, 24.97, 23.38,
    22.07, 20.49, 19.17, 17.62, 16.28, 14.77, 13.41, 11.92, 10.55, 9.10, 7.70, 6.28, 4.85, 3.47, 2.02, 0.66,
    -0.81, -2.15, -3.64, -4.96, -6.47, -7.78, -9.30, -10.61, -12.15, -13.42, -15.00, -16.26, -17.86, -19.11, -20.73,
    -21.97, -23.61, -24.85, -26.51, -27.73, -29.41, -30.63, -32.33, -33.54, -35.27, -36.47, -38.25, -39.43, -41.23,
    -42.43, -44.28, -45.46,
])  # fmt: skip
_OS1_128_DEG = np.array([
    20.95, 20.67, 20.36, 20.03, 19.73, 19.41, 19.11, 18.76, 18.47, 18.14, 17.82, 17.50, 17.19, 16.86, 16.53, 16.20,
    15.89, 15.56, 15.23, 14.90, 14.57, 14.23, 13.90, 13.57, 13.25, 12.91, 12.57, 12.22, 11.90, 11.55, 11.20, 10.87,
    10.54, 10.18, 9.84, 9.51, 9.15, 8.81, 8.47, 8.11, 7.78, 7.43, 7.08, 6.74, 6.39, 6.04, 5.70, 5.34,
    4.98, 4.64, 4.29, 3.93, 3.58, 3.24, 2.88, 2.53, 2.17, 1.82, 1.47, 1.12, 0.78, 0.41, 0.07, -0.28,
    -0.64, -0.99, -1.35, -1.70, -2.07, -2.40, -2.75, -3.11, -3.46, -3.81, -4.15, -4.50, -4.86, -5.22, -5.57, -5.90,
    -6.27, -6.61, -6.97, -7.30, -7.67, -8.01, -8.35, -8.69, -9.05, -9.38, -9.71, -10.07, -10.42, -10.76, -11.09,
    -11.43, -11.78, -12.12, -12.46, -12.78, -13.15, -13.46, -13.80, -14.12, -14.48, -14.79, -15.11, -15.46, -15.79,
    -16.12, -16.45, -16.76, -17.11, -17.44, -17.74, -18.06, -18.39, -18.72, -19.02, -19.32, -19.67, -19.99, -20.27,
    -20.57, -20.92, -21.22, -21.54, -21.82,
])  # fmt: skip


def _one_column(elevations_deg: FloatArray, columns: int, start_azimuth_deg: float, slot: float) -> Spinning:
    """Lasers straight above one another, firing in pairs of one from the lower half and one from the upper half.

    That is Velodyne's order: -15, 1, -13, 3, ... degrees for the VLP-16. `slot` is the part of a column's time that
    the firing takes, the rest is for recharging.
    """
    half = len(elevations_deg) // 2
    rank = np.concatenate([2 * np.arange(half), 2 * np.arange(half) + 1])
    firing = np.asarray(slot * rank / (2 * half), dtype=np.float64)
    return Spinning(elevations_deg, np.zeros(2 * half), firing, columns, start_azimuth_deg)


def _velodyne_64(columns: int, elevation_offsets_deg: FloatArray | float = 0.0) -> Spinning:
    """HDL-64E S2: an upper block with a third and a lower one with half a degree between the lasers.

    The lasers stand side by side in groups, about 3.2 degrees apart, as the calibration files that come with the
    devices show; both blocks fire at the same time. The offsets (64,) are the calibrated minus the nominal elevation
    of each laser, from the highest down.
    """
    elevations = np.concatenate([np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.33, 32)]) + elevation_offsets_deg
    side_by_side = np.array([7.9, 4.7, 1.5, -1.9, -5.1, -8.4, 9.1, 5.8, 2.6, -0.7, -3.9, -7.2])
    offsets = np.concatenate([side_by_side[(np.arange(32) + 8) % 12], side_by_side[np.arange(32) % 12]])
    firing = np.tile(np.linspace(0.0, 31.0 / 32.0, 32), 2)
    return Spinning(elevations[::-1], offsets[::-1], firing[::-1], columns)


def _ouster(altitudes_deg: FloatArray, azimuths_deg: list[float], columns: int) -> Spinning:
    """Ouster: all lasers of a column fire together; azimuth angles repeat and count clockwise, as in its metadata."""
    offsets = -np.resize(azimuths_deg, len(altitudes_deg))
    return Spinning(altitudes_deg, offsets, np.zeros(len(altitudes_deg)), columns)


# Range limits: VLP-16 100 m, HDL-32E 80 to 100 m, HDL-64E 120 m, OS0 50 m and OS1 120 m at 80 % reflectivity,
# XT32 120 m, Mid-360 70 m and Avia 320 m at 80 %. Packets of Velodyne count 2 mm, Hesai 4 mm, Ouster and Livox 1 mm.
_VELODYNE_SMALL = RangeModel(0.4, 100.0, 0.010, 0.00020, 0.0030, 0.002)
_VELODYNE_64 = RangeModel(0.9, 120.0, 0.010, 0.00015, 0.0020, 0.002)
_OS0 = RangeModel(0.3, 50.0, 0.010, 0.00050, 0.0061, 0.001)
_OS1_64 = RangeModel(0.5, 120.0, 0.010, 0.00025, 0.0031, 0.001)
_OS1_128 = RangeModel(0.3, 120.0, 0.008, 0.00025, 0.0031, 0.001)
_XT32 = RangeModel(0.1, 120.0, 0.005, 0.00010, 0.0017, 0.004)
_MID_360 = RangeModel(0.1, 70.0, 0.010, 0.00025, 0.0030, 0.001)
_AVIA_RANGES = RangeModel(1.0, 320.0, 0.015, 0.00025, 0.0030, 0.001)

# 55.296 us a column of 16 lasers 2.304 us apart (User Manual 63-9243), rounded to 0.2 degrees
_VLP_16 = _one_column(np.arange(-15.0, 16.0, 2.0), 1800, 0.0, 16 * 2.304 / 55.296)
# 46.08 us a column of 32 lasers 1.152 us apart
_HDL_32 = _one_column(np.linspace(-30.67, 10.67, 32), 2170, 0.0, 32 * 1.152 / 46.08)
# the first generation's design values: 33.2 degrees
_OS1_64_COLUMN = _ouster(np.linspace(16.611, -16.611, 64), [3.164, 1.055, -1.055, -3.164], 1024)
# 15 to -16 degrees in steps of one, 1.512 us from laser to laser, 50 us from column to column
_XT32_COLUMN = Spinning(np.arange(15.0, -17.0, -1.0), np.zeros(32), 1.512 * np.arange(32.0) / 50.0, 2000, 90.0)
# after the Mid-360: 200,000 points a second over 360 x 59 degrees, four lines
_ROSETTE = Rosette((-7.0, 52.0), 4, 5000, turns_per_sweep=0.5 * 5.0**0.5, nods_per_sweep=10.0 * 3.0**0.5)
# The same view as strokes of four lasers together, some ten degrees of azimuth apart, a turn a sweep.
_STROKES = Rosette((-7.0, 52.0), 4, 5000, 0.46 * 5.0**0.5, 10.0 * 3.0**0.5, laser_step_deg=1.2)
# 70.4 x 77.2 degrees of six lines, 240,000 points a second; the prisms turn about as fast as a Mid-40's, at 7294 and
# 4664 a minute.
_AVIA = RisleyPrisms(35.2, 6.8 / 5.0, 6, 4000, (7.0 * 3.0**0.5, 3.5 * 5.0**0.5))

# The HDL-64E with uneven rings, as every real one has: made-up offsets of the size that calibration files have.
_UNEVEN_DEG = np.clip(0.06 * np.random.default_rng(64).standard_normal(64), -0.12, 0.12)

_TABLE = (
    Sensor("vlp-16", "velodyne", 10.0, _VLP_16, _VELODYNE_SMALL),
    Sensor("hdl-32e", "velodyne", 10.0, _HDL_32, replace(_VELODYNE_SMALL, min_range_m=0.5)),
    # 48 us a column; KITTI's starts each turn at the rear
    Sensor("hdl-64e", "velodyne", 10.0, _velodyne_64(2083), _VELODYNE_64),
    Sensor("hdl-64e-calibrated", "velodyne", 10.0, _velodyne_64(2083, _UNEVEN_DEG), _VELODYNE_64),
    Sensor("os0-64", "ouster", 10.0, _ouster(_OS0_64_DEG, [9.2, -3.0], 1024), _OS0),
    Sensor("os1-64", "ouster", 10.0, _OS1_64_COLUMN, _OS1_64),
    Sensor("os1-128", "ouster", 10.0, _ouster(_OS1_128_DEG, [4.21, 1.41, -1.40, -4.21], 1024), _OS1_128),
    Sensor("xt32", "hesai", 10.0, _XT32_COLUMN, _XT32),
    Sensor("livox", "livox", 10.0, _ROSETTE, _MID_360),
    Sensor("mid-360", "livox", 10.0, _STROKES, _MID_360, has_rings=False),
    Sensor("avia", "livox", 10.0, _AVIA, _AVIA_RANGES, has_rings=False),
)
SENSORS: dict[str, Sensor] = {sensor.name: sensor for sensor in _TABLE}


def find_sensor(name: str) -> Sensor:
    return choose("sensor", name, SENSORS)
