"""A sensor on a carrier in a world: scans made one at a time, in any order, with the truth about them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.imu import MEMS_IMU, ImuModel, sample_imu
from lidarslam.simulation.mesh import Caster, Hits, first_ground_triangle
from lidarslam.simulation.motion import Motion, mount_pose
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import RangeModel, Rays, Sensor, find_sensor
from lidarslam.simulation.world import Grass, World, build_world

# Blades have all orientations; on average they reflect half of a beam's power.
_BLADE_COSINE = 0.5


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan and the truth about it; all arrays in the order of the scan's N points.

    The points are exact in float32, stamped at the sweep's start, as the drivers' message headers are. The true ranges
    are those along the rays before noise, edge effects and grass; inf where a point came from its neighbour's surface
    alone.
    """

    scan: Scan
    intensities: NDArray[np.float32]  # (N,) whole numbers from 0 to 255
    true_ranges: FloatArray | None = None  # (N,) or None if unknown
    moving: NDArray[np.bool_] | None = None  # (N,) whether the ray met a mover, or None if unknown


# Simulated time starts at zero, the clocks of drivers at 2024-01-01 00:00:00 UTC. Fixed, so that the same seed gives
# the same bytes; far from zero, so that readers can distinguish offsets from a stamp and readings of the clock.
CLOCK_START_NS = 1_704_067_200 * 10**9


def clock_ns(time: float, start_ns: int = CLOCK_START_NS) -> int:
    """The clock's reading at a simulated time in seconds, to the nanosecond."""
    return start_ns + round(time * 1e9)


def clock_s(time: float, start_ns: int = CLOCK_START_NS) -> float:
    """The same in seconds, the float64 that a reader makes of the nanoseconds."""
    return clock_ns(time, start_ns) / 10**9


@dataclass(frozen=True)
class Rig:
    """The sensor on its carrier, as far as a file format has to know it."""

    driver: str  # whose messages the sensor speaks: "velodyne", "ouster", "hesai" or "livox"
    sweep_s: float  # duration of a sweep
    T_world_lidar_at: Callable[[FloatArray], FloatArray]  # true poses (N, 4, 4) at times (N,), simulated seconds
    imu: ImuSamples | None = None  # on simulated time too; None where none is to be recorded


@dataclass(frozen=True, eq=False)
class Echoes:
    """The truth about one sweep, of all N rays fired, each from the pose at its own time."""

    rays: Rays  # in the LiDAR frame
    times: FloatArray  # (N,) seconds
    origins: FloatArray  # (N, 3) in the world
    directions: FloatArray  # (N, 3) in the world
    hits: Hits


@dataclass(frozen=True, eq=False)
class Simulation:
    """A recording that is made while it is read; a `ScanSequence` that takes no memory but the world's.

    Sweep i starts at i / rate seconds of simulated time and depends on nothing but the attributes and i.
    """

    world: World
    sensor: Sensor
    motion: Motion
    T_body_lidar: FloatArray  # (4, 4) how the sensor is mounted
    scan_count: int
    seed: int = 0  # of the noise
    imu_model: ImuModel = MEMS_IMU  # of the IMU on the LiDAR
    first: int = 0  # number of the sweep that the first scan is of

    @property
    def name(self) -> str:
        """World, sensor and motion."""
        return f"{self.world.name}-{self.world.seed}_{self.sensor.name}_{self.motion.name}-{self.seed}"

    @property
    def stamps(self) -> FloatArray:
        """(N,) the start of each sweep."""
        return np.array(self._sweeps) / self.sensor.rate_hz

    @property
    def _sweeps(self) -> range:
        return range(self.first, self.first + self.scan_count)

    @cached_property
    def ground_truth(self) -> Trajectory:
        """T_world_lidar at the stamps of the scans, exact."""
        return self.ground_truth_at(self.stamps)

    def ground_truth_at(self, stamps: FloatArray) -> Trajectory:
        """T_world_lidar at increasing stamps (N,), exact."""
        return Trajectory(stamps, self.T_world_lidar_at(stamps))

    @cached_property
    def imu(self) -> ImuSamples:
        """The samples of the IMU on the LiDAR, from the first sweep's start to the last one's end."""
        first_s, last_s = (sweep / self.sensor.rate_hz for sweep in (self.first, self._sweeps.stop))
        return sample_imu(self.imu_model, self.T_world_lidar_at, first_s, last_s, self.seed)

    def T_world_lidar_at(self, times: FloatArray) -> FloatArray:
        """(N, 4, 4) at times (N,) in seconds, exact."""
        # Unlike a matrix product this wakes no pool of threads, which takes longer than products so small.
        return np.asarray(np.einsum("nij,jk->nik", self.motion.pose_at(times), self.T_body_lidar))

    @cached_property
    def _caster(self) -> Caster:
        return Caster(self.world)

    def distance_to_surfaces(self, points: FloatArray) -> FloatArray:
        """Distances (N,) of points (N, 3) in the world from the nearest static surface."""
        return self._caster.distances(points)

    def __len__(self) -> int:
        return self.scan_count

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; the ones between are not made."""
        for index in self._sweeps[start:stop:step]:
            yield self.scan(index).scan

    def scan(self, index: int, echoes: Echoes | None = None) -> SimulatedScan:
        """One scan with intensities and truth, from the sweep's echoes if they are known already."""
        echoes = echoes or self.echoes(index)
        hits, model, pattern = echoes.hits, self.sensor.ranging, self.sensor.pattern
        rng = np.random.default_rng([self.seed, index])
        ranges, bloomed = bloom(model, hits.ranges, pattern.lasers, pattern.column_angle, rng)
        # A ray that only grazes an edge meets no surface whose slant would matter.
        cosines = np.where(bloomed, 1.0, hits.cosines)
        if self.world.grass is not None:
            ground = np.flatnonzero(~bloomed & (hits.surfaces >= first_ground_triangle(self.world)))
            points = echoes.origins[ground] + ranges[ground, None] * echoes.directions[ground]
            shorter, is_blade = ranges_in_grass(self.world.grass, points, ranges[ground], cosines[ground], rng)
            ranges[ground], cosines[ground[is_blade]] = shorter, _BLADE_COSINE
        shares = reflectivity(hits.surfaces)
        measured = measure(model, ranges, cosines, shares, rng)
        returned = np.flatnonzero(np.isfinite(measured))
        points = echoes.rays.directions[returned] * measured[returned, None]
        scan = Scan(
            points.astype(np.float32).astype(np.float64),
            index / self.sensor.rate_hz,
            echoes.rays.fractions[returned] * self.sensor.period_s,
            echoes.rays.rings[returned] if self.sensor.has_rings else None,
        )
        brightness = intensities(cosines[returned], shares[returned])
        return SimulatedScan(scan, brightness, hits.ranges[returned], hits.moving[returned])

    def echoes(self, index: int) -> Echoes:
        """The true intersections of the rays of one sweep, every one cast from the pose at its own time."""
        rays = self.sensor.pattern.rays(index)
        times = index / self.sensor.rate_hz + rays.fractions * self.sensor.period_s
        # Lasers that fire together share a pose.
        fresh = np.diff(times, prepend=-np.inf) > 0.0
        T_world_lidar = self.T_world_lidar_at(times[fresh])[np.cumsum(fresh) - 1]
        origins = T_world_lidar[:, :3, 3]
        directions = np.einsum("nij,nj->ni", T_world_lidar[:, :3, :3], rays.directions)
        hits = self._caster.cast(origins, directions, times, self.sensor.ranging.max_range_m)
        return Echoes(rays, times, origins, directions, hits)


def simulation_of(
    world: str, sensor: str, carrier: str, mount: str, scans: int, seed: int, speed_mps: float | None = None
) -> Simulation:
    """The simulation of parts by their names; the seed is that of the world, the motion and the noise.

    InputError where there is no such part, or the carrier cannot follow the world's route.
    """
    built = build_world(world, seed)
    motion = motion_along_route(carrier, built, seed, speed_mps)
    return Simulation(built, find_sensor(sensor), motion, mount_pose(mount, motion.sensor_height_m), scans, seed)


# Measurement noise: pure functions of whole sweeps (N,), in the order of the pattern's rays, so that the effects on one
# ray do not depend on the number of other returns; inf stands for no return.

# A surface seen at a smaller cosine than this (87 degrees) behaves as at it.
_LEAST_COSINE = 0.05
# The share of the range spread over a slanted footprint that shows as noise: the deviation of a uniform distribution
# would be 0.29, a beam is brighter in its middle.
_FOOTPRINT_SHARE = 0.2
_EDGE_STEP_M = 0.3
_EDGE_STEP_SHARE = 0.03
_MIXED_STEP_M = 1.5
_REFERENCE_REFLECTIVITY = 0.8
# Stands for the range of a ray that meets nothing, where it has to be compared.
_NOTHING_M = 1e6
# The tips of the blades are between this share of the grass's height and all of it.
_SHORTEST_BLADE = 0.5


def reflectivity(surfaces: NDArray[np.int64]) -> FloatArray:
    """Reflectivity (N,) in [0.1, 0.8] of the surfaces (N,) met; equal for a solid's neighbouring triangles.

    Numbers are scattered by Knuth's multiplicative hashing, four successive triangles together.
    """
    scattered = (np.abs(surfaces) // 4 * 2654435761) % 2**32
    return 0.1 + 0.7 * np.asarray(scattered, dtype=np.float64) / 2**32


def range_sigma(model: RangeModel, ranges: FloatArray, cosines: FloatArray) -> FloatArray:
    """Standard deviation (N,) of the range noise: electronics and the depth of a slanted footprint."""
    cosines = np.maximum(cosines, _LEAST_COSINE)
    electronics = model.sigma_m + model.sigma_per_m * ranges
    depth = ranges * model.beam_divergence * np.sqrt(1.0 - np.minimum(cosines, 1.0) ** 2) / cosines
    return np.asarray(np.hypot(electronics, _FOOTPRINT_SHARE * depth))


def return_probability(
    model: RangeModel, ranges: FloatArray, cosines: FloatArray, reflectivities: FloatArray
) -> FloatArray:
    """Probability (N,) that a ray comes back.

    The echo's power falls with reflectivity * cosine / range^2; detection falls from certain to none around the
    power of a surface of 80 % reflectivity met head-on at the maximum range. The fourth power makes the transition as
    wide as the published 10 % and 90 % ranges are apart.
    """
    power = reflectivities / _REFERENCE_REFLECTIVITY * np.maximum(cosines, _LEAST_COSINE)
    weakness = (ranges / model.max_range_m) ** 2 / power
    return np.asarray((1.0 - model.dropout) / (1.0 + weakness**4))


def bloom(
    model: RangeModel, ranges: FloatArray, lasers: int, column_angle: float, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Ranges (N,) with the edges of near things widened, and which of them (N,) changed.

    Next to an edge a ray behind it still touches it with part of its footprint: with the chance that its centre is
    less than half a beam away. It then returns the near range, or, where both surfaces are close enough to make one
    echo, something between.
    """
    finite = np.minimum(ranges, _NOTHING_M)
    grid = finite.reshape(-1, lasers)
    neighbour = np.minimum(np.roll(grid, 1, axis=0), np.roll(grid, -1, axis=0)).ravel()
    chance, mixing = rng.random((2, len(ranges)), dtype=np.float32)
    step = finite - neighbour
    edge = step > np.maximum(_EDGE_STEP_M, _EDGE_STEP_SHARE * finite)
    edge &= chance < 0.5 * model.beam_divergence / column_angle
    bloomed = ranges.copy()
    bloomed[edge] = (neighbour + np.where(step < _MIXED_STEP_M, mixing * step, 0.0))[edge]
    return bloomed, edge


def measure(
    model: RangeModel, ranges: FloatArray, cosines: FloatArray, reflectivities: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Measured ranges (N,), inf where there is none: noise, rounding, dropouts, limits."""
    noise = rng.standard_normal(len(ranges), dtype=np.float32)
    lost = rng.random(len(ranges), dtype=np.float32)
    returned = np.isfinite(ranges)
    true = np.where(returned, ranges, 1.0)
    measured = true + noise * range_sigma(model, true, cosines)
    measured = np.round(measured / model.resolution_m) * model.resolution_m
    returned &= lost < return_probability(model, true, cosines, reflectivities)
    returned &= (measured >= model.min_range_m) & (measured <= model.max_range_m)
    return np.where(returned, measured, np.inf)


def intensities(cosines: FloatArray, reflectivities: FloatArray) -> NDArray[np.float32]:
    """Calibrated intensities (N,), whole numbers on the drivers' scale of 0 to 255, without the effect of range."""
    return np.round(255.0 * reflectivities * cosines).astype(np.float32)


def ranges_in_grass(
    grass: Grass, points: FloatArray, ranges: FloatArray, cosines: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Ranges (N,) of rays to points (N, 3) on the ground that blades may shorten, and which (N,) ended at a blade.

    The path among blades of height h at incidence cosine c is h / c long; until a blade is met it is exponentially
    distributed (Beer and Lambert's law). Close by most rays reach the ground, far away hardly any.
    """
    tips = grass.heights.height_at(points[:, :2]) * rng.uniform(_SHORTEST_BLADE, 1.0, len(points))
    path = np.minimum(tips / np.maximum(cosines, _LEAST_COSINE), ranges)
    until_blade = rng.exponential(grass.free_path_m, len(points))
    is_blade = until_blade < path
    return ranges - np.where(is_blade, path - until_blade, 0.0), is_blade
